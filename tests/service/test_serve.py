"""`serve` as a process, with a dispatcher played by a script: up together, down together, nothing left."""

import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import httpx2
import pytest

from schemas.errors import InvalidInput
from service.keys import Scope, add_key, make_key
from service.serve import serve
from service.settings import read_settings
from workers.jobs.claims import Dispatcher, SegmentQueue
from workers.jobs.database import open_database

# Reports as a dispatcher does, has a child in a process group of its own, and notes both pids.
DISPATCHER = """
    import os, signal, subprocess, sys, time
    from workers.jobs.claims import Dispatcher, SegmentQueue
    from workers.jobs.database import open_database
    if "stubborn" in sys.argv:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen(["sleep", "600"], process_group=0)
    with open("pids", "a") as file:
        file.write(f"{os.getpid()} {child.pid}\\n")
    queue = SegmentQueue(open_database(os.environ["MOTIONLABEL_DATABASE_URL"]))
    queue.heartbeat(Dispatcher(id=str(os.getpid()), host="h", pid=os.getpid(), code_version="1", num_workers=2))
    time.sleep(600)
"""
SERVE = (
    "import os, sys; from service.serve import serve; from service.settings import read_settings; "
    "sys.exit(serve(read_settings(), sys.argv[1:], grace_s=0.3, first_delay_s=0.01, parent_pid=os.getppid()))"
)
PATIENCE_S = 200.0

pytestmark = pytest.mark.usefixtures("default_signals")


def wait_for(condition):
    for _ in range(int(PATIENCE_S / 0.02)):
        if found := condition():
            return found
        time.sleep(0.02)
    raise TimeoutError(condition)


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.fixture
def pids(tmp_path):
    """Return a function that tells the pids that the dispatchers noted, oldest first; none survives the test."""

    def read():
        path = tmp_path / "pids"
        return [int(pid) for pid in path.read_text().split()] if path.exists() else []

    yield read
    for pid in filter(is_alive, read()):
        os.kill(pid, signal.SIGKILL)


@pytest.fixture
def start(tmp_path, pids):
    """Return a function that starts serve with a dispatcher script, as a child of ``parent`` if there is one."""
    (tmp_path / "dispatcher.py").write_text(textwrap.dedent(DISPATCHER))
    variables = {"MOTIONLABEL_PORT": "0", "MOTIONLABEL_DATA_DIR": "data"}
    started = []

    def run(*command, parent=()):
        command = command or (sys.executable, "dispatcher.py")
        process = subprocess.Popen(
            [*parent, sys.executable, "-c", SERVE, *command],
            cwd=tmp_path,
            env=os.environ | variables,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize(("number", "kind"), [(signal.SIGTERM, "willing"), (signal.SIGINT, "stubborn")])
def test_a_signal_takes_everything_down_even_what_does_not_listen(start, pids, tmp_path, number, kind):
    process = start(sys.executable, "dispatcher.py", kind)
    line = process.stdout.readline()
    assert line.startswith("motionlabel serves http://127.0.0.1:")
    assert f"data under {tmp_path}" in line
    url = line.split()[2]
    assert httpx2.get(f"{url}/readyz", trust_env=False).json()["workers"] == 2
    assert all(map(is_alive, pids()))
    process.send_signal(number)
    assert process.wait(PATIENCE_S) == 0
    assert len(pids()) == 2
    assert not any(map(is_alive, pids()))
    assert process.communicate() == ("", "")
    with pytest.raises(httpx2.ConnectError):
        httpx2.get(f"{url}/healthz", trust_env=False)


def test_a_dispatcher_of_an_earlier_run_makes_nothing_ready(start, pids, tmp_path):
    (tmp_path / "data").mkdir()
    database = open_database(f"sqlite:///{tmp_path}/data/jobs.sqlite3")
    SegmentQueue(database).heartbeat(Dispatcher(id="old", host="h", pid=1, code_version="1", num_workers=8))
    process = start()
    url = process.stdout.readline().split()[2]
    assert [was["pid"] for was in httpx2.get(f"{url}/v1/status", trust_env=False).json()["dispatchers"]] == [
        pids()[0],
        1,
    ]
    database.close()


def test_a_signal_before_all_is_ready_leaves_nothing_either(start, pids):
    process = start()
    wait_for(pids)
    process.terminate()
    assert process.wait(PATIENCE_S) == 0
    assert not any(map(is_alive, pids()))


def test_serve_ends_when_its_parent_is_gone(start, pids):
    process = start(parent=("sh", "-c", '"$@"; exit', "sh"))
    process.stdout.readline()
    process.kill()
    assert process.communicate(timeout=PATIENCE_S) == ("", "")  # whoever lives would hold its ends of the pipes
    assert len(pids()) == 2
    assert not any(map(is_alive, pids()))


def test_a_dispatcher_that_dies_is_started_again_without_its_old_children(start, pids):
    process = start()
    process.stdout.readline()
    first, child = pids()
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: len(pids()) == 4)
    assert not is_alive(child)
    assert is_alive(pids()[2])
    process.terminate()
    assert process.wait(PATIENCE_S) == 0
    _, err = process.communicate()
    assert err == "motionlabel: the dispatcher ended with exit code -9: starting it again in 0.01 s\n"
    assert not any(map(is_alive, pids()))


def test_a_dispatcher_that_always_dies_ends_the_service(start):
    process = start("sh", "-c", "exit 7")
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out) == (1, "")
    *again, last = err.splitlines()
    assert len(again) == 5
    assert last == "motionlabel: the dispatcher ended 6 times within a minute (last exit code 7): giving up"


def test_an_address_that_is_taken_is_one_line(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InvalidInput, match=f"^cannot listen on 127.0.0.1:{port}: Address already in use; choose"):
            serve(read_settings(data_dir=tmp_path, port=port), ["false"])


def test_a_store_that_cannot_be_opened_is_one_line_and_nothing_is_started(tmp_path):
    (tmp_path / "jobs.sqlite3").mkdir()
    with pytest.raises(InvalidInput, match=r"^cannot open the job store"):
        serve(read_settings(data_dir=tmp_path, port=0), ["touch", str(tmp_path / "started")])
    assert not (tmp_path / "started").exists()


def test_its_own_store_of_an_earlier_version_is_migrated(start, tmp_path, make_old_store):
    (tmp_path / "data").mkdir()
    make_old_store(f"sqlite:///{tmp_path}/data/jobs.sqlite3")
    process = start()
    url = process.stdout.readline().split()[2]
    jobs = httpx2.get(f"{url}/v1/jobs", trust_env=False).json()["jobs"]
    assert {job["id"]: (job["state"], job["owner"]) for job in jobs} == {
        "ended": ("SUCCEEDED", ""),
        "begun": ("RUNNING", ""),
    }
    process.terminate()
    _, err = process.communicate(timeout=PATIENCE_S)
    assert err == f"motionlabel: job store sqlite:///{tmp_path}/data/jobs.sqlite3: 0001 -> version 0005\n"


def test_a_store_that_others_may_use_is_not_migrated_by_the_way(tmp_path, make_old_store):
    url = f"sqlite:///{tmp_path}/shared.sqlite3"
    make_old_store(url)
    with pytest.raises(InvalidInput, match=r"has version 0001, .*run `motionlabel migrate` with the same settings$"):
        serve(read_settings(data_dir=tmp_path, database_url=url, port=0), ["false"])


def test_a_data_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInput, match=r"^cannot make data folder"):
        serve(read_settings(data_dir=tmp_path / "file/data"))


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.1.2.3", "fd00::1", "labels.example", "127.0.0.1.example"])
def test_other_machines_are_let_in_with_keys_only(tmp_path, host):
    with pytest.raises(InvalidInput) as caught:
        serve(read_settings(data_dir=tmp_path / "data", host=host, port=0), ["false"])
    assert str(caught.value) == (
        f"listening on {host} lets other machines in: make a key with `motionlabel key new --owner NAME "
        "--scope submit --file FILE` and start with --api-keys FILE, or listen on 127.0.0.1"
    )
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("text", [None, "{"], ids=["missing", "broken"])
def test_keys_that_cannot_be_read_are_one_line_and_nothing_is_started(tmp_path, text):
    path = tmp_path / "keys"
    if text is not None:
        path.write_text(text)
        path.chmod(0o600)
    with pytest.raises(InvalidInput, match=f"{path}"):
        serve(read_settings(data_dir=tmp_path, port=0, api_keys_file=path), ["touch", str(tmp_path / "started")])
    assert not (tmp_path / "started").exists()


def test_with_keys_it_serves_all_addresses_and_asks(start, tmp_path, monkeypatch):
    key, token = make_key("ann", [Scope.READ])
    add_key(tmp_path / "keys", key)
    monkeypatch.setenv("MOTIONLABEL_API_KEYS_FILE", "keys")
    monkeypatch.setenv("MOTIONLABEL_HOST", "0.0.0.0")
    url = start().stdout.readline().split()[2]
    headers = {"Authorization": f"Bearer {token}"}
    assert httpx2.get(f"{url}/v1/status", trust_env=False).status_code == 401
    assert httpx2.get(f"{url}/v1/status", trust_env=False, headers=headers).status_code == 200
