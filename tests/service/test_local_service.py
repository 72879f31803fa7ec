"""A service of one's own: got ready, told what fails in one line, and gone afterwards however the block is left."""

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest

from schemas.api.jobs import JobRequest
from schemas.config import resolve_config
from service.client import ServiceError
from service.local_service import local_service, make_request

# Says it is ready as serve does, with its folder, its data folder and what else it was told, and notes its end.
SERVICE = """
    echo $$ > pid
    trap 'echo stopped > end; exit 0' TERM
    echo "motionlabel serves http://$PWD:$MOTIONLABEL_DATA_DIR:$MOTIONLABEL_DATABASE_URL:$0=$1 (and more)"
    while true; do sleep 0.05; done
"""


pytestmark = pytest.mark.usefixtures("default_signals")


def is_alive(pid):
    return Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ServiceError])
def test_it_is_gone_however_the_block_is_left(tmp_path, error):
    with pytest.raises(error) if error else nullcontext(), local_service(tmp_path, ["sh", "-c", SERVICE]):
        assert is_alive((tmp_path / "pid").read_text().strip())
        if error:
            raise error
    assert (tmp_path / "end").read_text() == "stopped\n"
    assert not is_alive((tmp_path / "pid").read_text().strip())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_as_ctrl_c_does(tmp_path, number):
    def be_told():
        with local_service(tmp_path, ["sh", "-c", SERVICE]):
            os.kill(os.getpid(), number)
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        be_told()
    assert not is_alive((tmp_path / "pid").read_text().strip())
    assert signal.getsignal(number) is signal.SIG_DFL


def test_it_runs_in_the_data_root_and_heeds_no_setting(tmp_path, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_DATABASE_URL", "postgresql://elsewhere")
    with local_service(tmp_path, ["sh", "-c", SERVICE]) as url:
        root, data_dir, database_url, parent = url.removeprefix("http://").split(":")
        assert (root, database_url, parent) == (str(tmp_path), "", f"--parent-pid={os.getpid()}")
        assert Path(data_dir).is_dir()
        assert tmp_path not in Path(data_dir).parents
    assert not Path(data_dir).exists()


@pytest.mark.parametrize(
    ("script", "ready_s", "message"),
    [
        ("echo 'ERROR no room' >&2; echo later >&2; exit 1", 60, "ended with exit code 1: ERROR no room"),
        ("echo bad port >&2; exit 2", 60, "ended with exit code 2: bad port"),
        ("exit 3", 60, "ended with exit code 3"),
        ("echo 'IOError: no Ray' >&2; exec sleep 60", 2, "was not ready for jobs within 2 s: IOError: no Ray"),
    ],
)
def test_a_service_that_does_not_get_ready_is_one_line(tmp_path, script, ready_s, message):
    with pytest.raises(ServiceError) as raised, local_service(tmp_path, ["sh", "-c", script], ready_s=ready_s):
        pass
    assert str(raised.value) == f"the service {message}"


@pytest.mark.parametrize(
    "config",
    [
        resolve_config("paper", {"sweeps": (2, 8), "flow.iterations": 80}),
        resolve_config("fast", {"write_points": True, "seed": 5}),
    ],
)
def test_the_job_has_exactly_the_config(config, tmp_path):
    request = JobRequest.model_validate(make_request("synthetic", ["synthetic:street"], tmp_path / "out", config))
    assert request.make_config() == config


@pytest.mark.parametrize("command", [["-m", "service"], ["-P", "-m", "service"]])
def test_the_module_is_the_command_line(command, tmp_path):
    done = subprocess.run([sys.executable, *command, "--version"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout[:12]) == (0, "motionlabel ")


@pytest.mark.ray
def test_the_demo_runs_through_the_service_and_runs_again(cli, tmp_path):
    arguments = ("demo", "--output", tmp_path / "out", "--sweeps", 2)
    code, out, err = cli(*arguments)
    assert (code, err) == (0, [])
    summary, cost, *_ = out.splitlines()
    assert summary.startswith(f"{tmp_path / 'out'}: 1 of 1 segment labelled, 2 sweeps (0 rejected), ")
    assert cost.endswith("core-seconds a sweep")
    assert f"picture: {tmp_path / 'out/picture.png'}" in out
    code, again, _ = cli(*arguments)
    assert code == 0
    assert again.splitlines()[:2] == [summary, "1 segment was already there"]
    assert again.partition("\n\n")[2] == out.partition("\n\n")[2]  # the same figures
