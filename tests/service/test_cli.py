import subprocess
import sys
from importlib.metadata import entry_points, version

import pytest

from service.cli import main

CLIENTS = ["submit", "status", "watch", "cancel", "retry", "backfill"]
COMMANDS = ["label", "evaluate", "demo", "render", "export", *CLIENTS, "serve", "migrate"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(cli, command):
    code, out, _ = cli(command, "--help")
    assert code == 0
    assert f"Example: motionlabel {command}" in out


def test_top_level_help_lists_the_commands(cli):
    code, out, _ = cli("--help")
    assert code == 0
    assert all(f"\n  {command} " in out for command in COMMANDS)


def test_version(cli):
    assert cli("--version") == (0, f"motionlabel {version('motionlabel')}\n", [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing command"),
        (["lable"], "No such command 'lable'"),
        (["label", "x", "--output", "y"], "Missing option '--dataset'"),
        (["demo", "--sweeps", "many"], "Invalid value for '--sweeps'"),
    ],
)
def test_wrong_usage_is_one_line(cli, arguments, message):
    code, out, err = cli(*arguments)
    assert (code, out) == (2, "")
    assert len(err) == 1
    assert message in err[0]
    assert "--help`)" in err[0]


@pytest.mark.parametrize("command", ["label", "submit"])
def test_an_empty_output_is_not_this_folder(cli, command):
    code, out, err = cli(command, "log", "--dataset", "av2", "--output", "")
    assert (code, out) == (2, "")
    assert err == ["motionlabel: --output is empty: expected a path or s3://bucket/prefix, or . for this folder"]


def test_an_empty_output_of_the_demo_is_not_this_folder(cli):
    assert cli("demo", "--output", "")[0] == 2


def interrupt(*_, **__):
    raise KeyboardInterrupt


def test_ctrl_c_of_a_service_that_starts_stops_it(cli, monkeypatch):
    monkeypatch.setattr("service.serve.serve", interrupt)
    assert cli("serve") == (0, "", [])


def test_ctrl_c_of_what_keeps_nothing_promises_nothing(cli, monkeypatch):
    monkeypatch.setattr("service.client.Client.get", interrupt)
    code, _, err = cli("status")
    assert (code, err) == (130, ["motionlabel: interrupted"])


def test_help_loads_nothing_heavy():
    heavy = ["torch", "open3d", "sklearn", "scipy", "matplotlib", "pyarrow"]
    script = (
        "import sys; from service.cli import main; main(['label', '--help']); "
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "[]"


def test_the_script_is_this_main():
    (script,) = entry_points(group="console_scripts", name="motionlabel")
    assert script.load() is main
