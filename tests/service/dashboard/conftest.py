"""The dashboard in process, and a headless Chromium that is spoken to over a pipe (its DevTools protocol)."""

import itertools
import json
import os
import select
import shutil
import subprocess
import time

import pytest
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


class Browser:
    """One page of a headless Chromium. What its console and its security policy complain about is kept."""

    def __init__(self, process, to_browser, from_browser):
        self._process, self._to, self._from = process, to_browser, from_browser
        self._numbers, self._buffer, self._session = itertools.count(1), b"", None
        self.complaints = []
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
        self._send(
            "Emulation.setDeviceMetricsOverride", width=width_px, height=height_px, deviceScaleFactor=1, mobile=True
        )

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
            case "Page.javascriptDialogOpening":  # a question is answered with yes
                number = next(self._numbers)
                message = {"id": number, "method": "Page.handleJavaScriptDialog", "params": {"accept": True}}
                os.write(self._to, json.dumps(message | {"sessionId": self._session}).encode() + b"\0")


@pytest.fixture
def browser(tmp_path):
    """A headless Chromium."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    child_reads, we_write = os.pipe()
    we_read, child_writes = os.pipe()
    options = f"--headless --no-sandbox --disable-gpu --remote-debugging-pipe --user-data-dir={tmp_path}/chromium"
    process = subprocess.Popen(
        ["sh", "-c", f'exec "$0" {options} 3<&{child_reads} 4>&{child_writes}', found],
        pass_fds=(child_reads, child_writes),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(child_reads)
    os.close(child_writes)
    try:
        yield Browser(process, we_write, we_read)
    finally:
        process.terminate()
        process.wait()
        os.close(we_write)
        os.close(we_read)
