import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"torch", "open3d", "sklearn", "scipy", "matplotlib", "ray"}


@pytest.mark.parametrize("name", sorted(p.parent.name for p in ROOT.glob("*/__init__.py")))
def test_package_name_resolves_inside_the_repository(name):
    module = importlib.import_module(name)
    assert Path(module.__file__).resolve().parent == ROOT / name


def test_the_rooms_are_there():
    assert {p.parent.name for p in ROOT.glob("*/__init__.py")} >= {"schemas", "labeling", "workers", "service"}


def test_the_package_list_is_whole():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    rooms = [p.parent for p in ROOT.glob("*/__init__.py")]
    found = {str(p.parent.relative_to(ROOT)).replace("/", ".") for room in rooms for p in room.rglob("__init__.py")}
    assert set(listed) == found
    assert len(listed) == len(found)


def test_the_job_store_needs_no_workers_and_no_web():
    code = "import workers.jobs.store, workers.jobs.claims, sys; print(*{m.partition('.')[0] for m in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(loaded.stdout.split()) & (HEAVY | {"fastapi", "labeling", "service"}) == set()
    assert "sqlalchemy" in loaded.stdout.split()


def test_command_line_starts_without_heavy_packages():
    code = "import sys, service.cli; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(loaded.stdout.split()) & HEAVY == set()
    assert "service" in loaded.stdout.split()


def test_commands_that_do_not_label_load_no_ray():
    code = "import sys, service.cli, workers.jobs.store, workers.jobs.claims; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {name.partition(".")[0] for name in loaded.stdout.split()} & HEAVY == set()
