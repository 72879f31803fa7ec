"""The Dockerfile says the same as the rest of the repository. It is parsed here, not built."""

import importlib.util
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import typer

from service.cli import app
from service.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def read_instructions():
    """Return the Dockerfile as pairs of instruction and text, its continued lines joined."""
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [tuple(line.split(maxsplit=1)) for line in joined.splitlines() if line.strip()]


@pytest.fixture(scope="module")
def texts():
    """Return a function that lists the texts of one kind of instruction."""
    instructions = read_instructions()
    return lambda kind: [text for name, text in instructions if name == kind]


@pytest.fixture(scope="module")
def system_packages():
    spec = importlib.util.spec_from_file_location("system_libraries", ROOT / "deploy" / "system_libraries.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return set(module.PACKAGE_OF_LIBRARY.values())


@pytest.fixture(scope="module")
def copied(texts):
    return [source for text in texts("COPY") for source in text.split()[:-1]]


def test_every_copied_path_exists_and_is_sent_to_the_builder(copied):
    assert all((ROOT / source).exists() for source in copied)
    ignored, *rest = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if not line.startswith("#")]
    assert ignored == "*"
    assert {line[1:] for line in rest if line.startswith("!")} == set(copied)


def test_all_packages_are_copied(copied):
    assert {package.partition(".")[0] for package in PROJECT["tool"]["setuptools"]["packages"]} <= set(copied)
    assert PROJECT["project"]["readme"] in copied


def test_python_is_one_that_the_project_takes(texts):
    (image,) = texts("FROM")
    major, minor = re.fullmatch(r"python:(\d+)\.(\d+)-slim-bookworm", image).groups()
    assert PROJECT["project"]["requires-python"] == f">={major}.{minor}"


def test_the_system_libraries_are_installed(texts, system_packages):
    (install,) = [text for text in texts("RUN") if "apt-get install" in text]
    words = shlex.split(install.partition("apt-get install")[2].partition("&&")[0])
    assert {word for word in words if not word.startswith("-")} == system_packages


def test_torch_is_the_pinned_one_and_comes_first(texts):
    torch, rest = [text for text in texts("RUN") if text.startswith("pip install")]
    assert re.search(r"^torch==(.*)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)[0] == torch.split()[-1]
    assert "https://download.pytorch.org/whl/cpu" in torch
    assert "-c constraints.txt" in rest
    extras = re.search(r"\.\[(.*)\]", rest)[1].split(",")
    assert set(extras) == set(PROJECT["project"]["optional-dependencies"]) - {"dev"}


def test_the_user_is_not_root(texts):
    (user,) = texts("USER")
    assert any(f" {user} " in f"{text} " for text in texts("RUN") if "useradd" in text)


def test_the_entry_point_is_a_command(texts):
    (entry,), (command,) = texts("ENTRYPOINT"), texts("CMD")
    assert json.loads(entry)[0] in PROJECT["project"]["scripts"]
    assert json.loads(command)[0] in typer.main.get_command(app).commands


def test_the_environment_is_understood_and_says_where_to_listen(texts):
    variables = dict(pair.split("=") for text in texts("ENV") for pair in text.split())
    ours = {name.removeprefix("MOTIONLABEL_").lower() for name in variables if name.startswith("MOTIONLABEL_")}
    assert ours <= set(Settings.model_fields)
    assert texts("EXPOSE") == [variables["MOTIONLABEL_PORT"]]
    # Listening to other machines, it asks for keys, which outlive the container.
    assert variables["MOTIONLABEL_HOST"] == "0.0.0.0"
    (volumes,) = map(json.loads, texts("VOLUME"))
    assert str(Path(variables["MOTIONLABEL_API_KEYS_FILE"]).parent) in volumes
    assert variables["MOTIONLABEL_API_KEYS_FILE"].startswith(variables["MOTIONLABEL_DATA_DIR"])
    (check,) = texts("HEALTHCHECK")
    assert f"http://127.0.0.1:{variables['MOTIONLABEL_PORT']}/healthz" in check
