"""Small logs, the command line, the service, and a headless Chromium that is driven over a pipe."""

import contextlib
import itertools
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import threading
import time

import numpy as np
import pytest
import uvicorn
from fastapi.testclient import TestClient

from labeling.readers.reader import sweep_range
from schemas.api.jobs import Failure, SegmentState
from schemas.errors import UnreadableSweep
from schemas.manifest import SegmentEntry, Shard
from schemas.objects import LabeledTrack, SweepObservation, SweepPoints
from service.app import create_app
from service.cli import main
from service.keys import Scope, add_key, make_key
from service.settings import read_settings
from workers.jobs.claims import SegmentQueue
from workers.jobs.database import open_database

_PATIENCE_S = 60  # of a busy machine


@pytest.fixture
def write_log(tmp_path, write_av2):
    """Return a builder of small AV2 logs: a road, a wall, and one block that drives at ``speed_mps``."""

    def write(name="log", num_sweeps=6, *, speed_mps=8.0, times_s=None):
        rng = np.random.default_rng(0)
        times_s = np.arange(num_sweeps) / 10 if times_s is None else np.asarray(times_s)
        road = np.column_stack([rng.uniform(-20, 20, (1500, 2)), rng.normal(0, 0.01, 1500)])
        wall = np.column_stack([rng.uniform(-20, 20, 400), np.full(400, 9.0), rng.uniform(0, 3, 400)])
        block = rng.uniform([-2, -1, 0.3], [2, 1, 1.8], (300, 3))
        places = [(speed_mps * time_s - 6, 4, 0) for time_s in times_s]
        return write_av2(tmp_path / name, times_s, [np.concatenate([road, wall, block + place]) for place in places])

    return write


@pytest.fixture
def default_signals():
    """Let signals do what they do by default: whoever runs the tests may ignore some, and Ray handles others."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.SIG_DFL) for number in numbers}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def damage_sweep():
    """Return a function that cuts a sweep's file in half and returns its name."""

    def damage(log, index):
        path = sorted((log / "sensors/lidar").iterdir())[index]
        path.write_bytes(path.read_bytes()[:100])
        return path.name

    return damage


@pytest.fixture
def cli(capsys):
    """Return a function that runs the command line and returns exit code, stdout and stderr lines."""

    def run(*arguments):
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err.splitlines()

    return run


@pytest.fixture
def label(cli, tmp_path):
    """Return a function that labels logs into ``out``."""

    def run(*arguments, output="out"):
        return cli("label", "--dataset", "av2", "--output", tmp_path / output, *arguments)

    return run


@pytest.fixture
def fast_stages(monkeypatch):
    """Replace the stages by trivial ones: every 100th point is dynamic, one track of 5 m/s goes through all sweeps."""

    def describe(rows):
        zeros = np.zeros(len(rows), dtype=np.int32)
        return SweepPoints(np.zeros((len(rows), 3), dtype=np.float32), rows, zeros == 0, zeros, None)

    def observe_sweeps(reader, config):
        none = np.empty(0, dtype=np.int32)
        for index in sweep_range(reader, config):
            counts = {"num_points": 0, "num_ground": 0, "num_static": 0, "num_clusters": 0, "num_failed_fits": 0}
            points, reason, pose = none, "", np.eye(4)
            try:
                sweep = reader.read_sweep(index)
                points = np.arange(0, sweep.num_points, 100, dtype=np.int32)
                counts.update(num_points=sweep.num_points, num_clusters=1)
            except UnreadableSweep as error:
                reason = str(error)
            yield SweepObservation(
                sweep_index=index,
                timestamp_ns=int(reader.timestamps_ns[index]),
                world_from_ego=pose,
                reason=reason,
                proposals=(),
                points=None if reason else describe(points),
                **counts,
            )

    def label_tracks(proposals_of_sweeps, clock, config, segment_id):
        size = len(clock.sweep_index)
        boxes = np.tile([0.0, 0, 0, 4, 2, 1.5, 0], (size, 1))
        return [
            LabeledTrack(
                track_id=f"track of {segment_id}",
                sweep_index=clock.sweep_index,
                timestamp_ns=clock.timestamp_ns,
                boxes=boxes,
                velocity_mps=np.tile([5.0, 0, 0], (size, 1)),
                score=np.ones(size),
                num_points=np.ones(size, dtype=np.int64),
                is_observed=np.ones(size, dtype=bool),
                boxes_visible=boxes,
                registration_error_m=np.zeros(size),
                point_rows=tuple(np.array([100], dtype=np.int32) for _ in range(size)),
            )
        ]

    monkeypatch.setattr("labeling.in_process.observe_sweeps", observe_sweeps)
    monkeypatch.setattr("labeling.in_process.label_tracks", label_tracks)


@pytest.fixture
def settings(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "state").mkdir()
    return read_settings(data_dir=tmp_path / "state", data_roots=(str(tmp_path / "data"),))


@pytest.fixture
def running(monkeypatch):
    """A context in which a service runs on this machine, without a dispatcher; its URL is in the environment."""

    @contextlib.contextmanager
    def run(settings):
        listener = socket.create_server(("127.0.0.1", 0))
        app = create_app(settings)
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        while not server.started:
            time.sleep(0.01)
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        monkeypatch.setenv("MOTIONLABEL_SERVER", url)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        try:
            yield url
        finally:
            app.state.streams.close()
            server.should_exit = True
            thread.join()
            listener.close()

    return run


@pytest.fixture
def server(settings, running):
    with running(settings) as url:
        yield url


@pytest.fixture
def keyed(settings, tmp_path):
    """The same settings, with a file of API keys that has none yet."""
    path = tmp_path / "keys"
    path.touch(mode=0o600)
    return settings.model_copy(update={"api_keys_file": path})


@pytest.fixture
def issue(keyed):
    """Return a function that adds a key to the file and returns its token."""

    def run(owner="ann", *scopes, **values):
        key, token = make_key(owner, scopes or (Scope.SUBMIT,), **values)
        add_key(keyed.api_keys_file, key)
        return token

    return run


@pytest.fixture
def queue(settings):
    database = open_database(settings.store_url)
    yield SegmentQueue(database)
    database.close()


@pytest.fixture
def finish(queue):
    """Return a function that labels the next segment that waits, or fails it."""

    def run(state="SUCCEEDED"):
        claim = queue.claim_segment("test", lease_s=60)
        if state in ("FAILED", "CRASHED"):
            queue.finish(claim, SegmentState(state), failure=Failure(error="InvalidInput", message="no sweeps"))
            return claim
        shard = Shard(table="labels", path=f"labels/{claim.position}.parquet", rows=7, bytes=100, sha256="0" * 64)
        entry = SegmentEntry(segment_id=f"s-{claim.position}", uri=claim.uri, state=state, shards=(shard,))
        queue.finish(claim, SegmentState(state), entry=entry)
        return claim

    return run


@pytest.fixture
def end_jobs(queue):
    def run():
        return [queue.end_job(job) for job in queue.list_finished_jobs()]

    return run


@pytest.fixture
def api(settings):
    with TestClient(create_app(settings), base_url="http://127.0.0.1:8000", raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def request_body(settings):
    def make(**changes):
        body = {
            "dataset": "synthetic",
            "segments": ["synthetic:street?sweeps=30"],
            "output_uri": f"{settings.data_roots[0]}/out",
        }
        return body | changes

    return make


@pytest.fixture
def submit(api, request_body):
    def run(**changes):
        answer = api.post("/v1/jobs", json=request_body(**changes))
        assert answer.status_code == 202, answer.text
        return answer.json()["id"]

    return run


@pytest.fixture
def assert_problem():
    """Return a function that checks that an answer is a problem document of one line, and returns it."""

    def check(answer, status, detail=""):
        assert answer.headers["content-type"] == "application/problem+json"
        problem = answer.json()
        assert (answer.status_code, problem["status"]) == (status, status)
        assert detail in problem["detail"]
        assert "\n" not in problem["detail"]
        assert problem["type"].startswith("urn:motionlabel:problem:")
        assert problem["instance"] == answer.request.url.path
        assert "Traceback" not in answer.text
        return problem

    return check


class Browser:
    """One page of a headless Chromium, spoken to in its DevTools protocol.

    What its console and its security policy complain about is kept.
    """

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
    options = (
        "--headless --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
        f"--remote-debugging-pipe --user-data-dir={tmp_path}/chromium"
    )
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
