import importlib.util
import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def system_libraries():
    spec = importlib.util.spec_from_file_location("system_libraries", ROOT / "deploy" / "system_libraries.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_complete_machine_is_left_alone(system_libraries, monkeypatch, capfd):
    monkeypatch.setattr(system_libraries, "PACKAGE_OF_LIBRARY", {"libc.so.6": "libc6"})
    assert system_libraries.main() == 0
    assert capfd.readouterr() == ("", "")


def test_without_root_one_line_says_what_to_run(system_libraries, monkeypatch, capfd):
    monkeypatch.setattr(system_libraries, "PACKAGE_OF_LIBRARY", {"libnot-here.so.9": "libnot-here9", "libc.so.6": "c"})
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert system_libraries.main() == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "sudo apt-get install libnot-here9 " in err


def test_an_old_python_is_named(system_libraries, monkeypatch, capfd):
    monkeypatch.setattr(system_libraries, "OLDEST_PYTHON", (9, 0))
    assert system_libraries.main() == 2
    assert "needs Python 3.11" in capfd.readouterr().err


def test_root_installs_what_is_missing_and_checks_again(system_libraries, monkeypatch):
    ran = []
    monkeypatch.setattr(system_libraries, "PACKAGE_OF_LIBRARY", {"libnot-here.so.9": "libnot-here9"})
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(system_libraries.shutil, "which", lambda _: "/usr/bin/apt-get")
    monkeypatch.setattr(system_libraries.subprocess, "run", lambda command, **_: ran.append(command[1:]))
    assert system_libraries.main() == 2  # apt did not help: the line is printed after all
    assert [command[0] for command in ran] == ["update", "install"]
    assert ran[1][-1] == "libnot-here9"


def test_every_direct_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(d for extra in project["optional-dependencies"].values() for d in extra)]
    pins = re.findall(r"^([\w.-]+)==([\w.]+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert {re.match(r"[\w-]+", requirement)[0] for requirement in wanted} <= {name for name, _ in pins}


def test_help_lists_every_target():
    targets = set(re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1].split())
    listed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert {line.split()[1] for line in listed.splitlines() if line.startswith("  make ")} == targets
