"""The dashboard in process and on a port, and a headless Chromium, spoken to over a pipe in its DevTools protocol."""

import contextlib
import itertools
import json
import os
import select
import shutil
import subprocess
import threading
import time

import pytest
import uvicorn
from fastapi.testclient import TestClient

from schemas.api.jobs import JobRequest
from service.app import create_app
from workers.jobs.database import open_database
from workers.jobs.store import JobStore

URL = "http://127.0.0.1:8000"
_PATIENCE_S = 60  # of a busy machine


@pytest.fixture
def site(settings):
    """A client of the dashboard that follows no redirect."""
    with TestClient(
        create_app(settings), base_url=URL, raise_server_exceptions=False, follow_redirects=False
    ) as client:
        yield client


@pytest.fixture
def submit(settings):
    """A function that submits a job past the API's checks of places, and returns its id."""
    database = open_database(settings.store_url)
    store, numbers = JobStore(database), itertools.count()

    def run(num_segments=1, **changes):
        uris = [f"synthetic:street?seed={next(numbers)}" for _ in range(num_segments)]
        body = {"dataset": "synthetic", "segments": uris, "output_uri": "/labels", **changes}
        return store.submit(JobRequest.model_validate(body)).id

    yield run
    database.close()


@pytest.fixture
def address(settings):
    """The address of a service on a port of its own, without a dispatcher."""
    with serving(settings) as url:
        yield url


@pytest.fixture
def keyed_address(keyed):
    """The same, of a service that asks for API keys."""
    with serving(keyed) as url:
        yield url


@contextlib.contextmanager
def serving(settings):
    server = uvicorn.Server(uvicorn.Config(create_app(settings), port=0, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()


class Browser:
    """One page of a headless Chromium. What its console and its security policy complain about is kept."""

    def __init__(self, to_browser, from_browser):
        self._to, self._from = to_browser, from_browser
        self._numbers, self._buffer, self._session = itertools.count(1), b"", None
        self.complaints, self.questions = [], []
        target = self._send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._send(f"{domain}.enable")

    def open(self, url):
        """Go to a page and wait until it is there."""
        self._send("Page.navigate", url=url)
        self.wait_for(f"location.href === {json.dumps(url)} && document.readyState === 'complete'")

    def ask(self, expression):
        """Return the value of an expression in the page."""
        answer = self._send("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, expression):
        """Wait until an expression is true; while the page changes, there may be nothing to ask."""
        end_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end_s:
            answer = self._send("Runtime.evaluate", expression=expression, returnByValue=True)
            if answer.get("result", {}).get("value") is True:
                return
            time.sleep(0.05)
        pytest.fail(f"{expression} is not true; the page says: {self.ask('document.body.innerText')}")

    def press(self, key, code):
        """Press a key, as a person does."""
        text = {"text": "\r"} if key == "Enter" else {}
        for kind in ("keyDown", "keyUp"):
            self._send("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code, **text)

    def resize(self, width_px, height_px):
        """Make the window as large as that of a phone."""
        size = {"width": width_px, "height": height_px}
        self._send("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=True)

    def _send(self, method, **parameters):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == number:
                return answer.get("result", {})
            self._note(answer)

    def _receive(self):
        end_s = time.monotonic() + _PATIENCE_S
        while b"\0" not in self._buffer:
            assert select.select([self._from], [], [], max(0, end_s - time.monotonic()))[0], "Chromium is silent"
            chunk = os.read(self._from, 1 << 20)
            assert chunk, "Chromium has ended"
            self._buffer += chunk
        line, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(line)

    def _note(self, event):
        details = event.get("params", {})
        match event.get("method"):
            case "Log.entryAdded" if details["entry"]["level"] in ("warning", "error"):
                self.complaints.append(details["entry"]["text"])
            case "Runtime.consoleAPICalled" if details["type"] in ("warning", "error", "assert"):
                self.complaints.append([argument.get("value") for argument in details["args"]])
            case "Runtime.exceptionThrown":
                self.complaints.append(details["exceptionDetails"])
            case "Page.javascriptDialogOpening":  # it is answered with yes
                self.questions.append(details["message"])
                number = next(self._numbers)
                message = {"id": number, "method": "Page.handleJavaScriptDialog", "params": {"accept": True}}
                os.write(self._to, json.dumps(message | {"sessionId": self._session}).encode() + b"\0")


@pytest.fixture
def browser(tmp_path):
    """A page of a headless Chromium."""
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    its_input, ours_out = os.pipe()
    ours_in, its_output = os.pipe()
    options = f"--headless --no-sandbox --disable-gpu --remote-debugging-pipe --user-data-dir={tmp_path}/chromium"
    process = subprocess.Popen(
        ["bash", "-c", f'exec "$0" {options} 3<&{its_input} 4>&{its_output}', found],
        pass_fds=(its_input, its_output),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(its_input)
    os.close(its_output)
    try:
        yield Browser(ours_out, ours_in)
    finally:
        process.terminate()
        process.wait()
        os.close(ours_out)
        os.close(ours_in)
