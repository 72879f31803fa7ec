"""What the documentation shows works: its Python runs, its commands parse, its links and names exist."""

import contextlib
import importlib
import re
import shlex
from pathlib import Path

import pytest
import typer

from schemas.config import resolve_config
from schemas.tables import SCHEMAS, merged, trajectories
from service.cli import app, main

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
COMMANDS = typer.main.get_command(app).commands


def leaves(commands):
    """Every command under its full name, as ("ablate", "flow")."""
    for name, command in commands.items():
        if hasattr(command, "commands"):
            yield from (((name, *path), leaf) for path, leaf in leaves(command.commands))
        else:
            yield (name,), command


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def blocks(language):
    """Every fenced block of a language as a test parameter: page and line say where it stands."""
    for page in PAGES:
        text = page.read_text()
        for match in re.finditer(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
            line = text[: match.start(1)].count("\n") + 1
            yield pytest.param(match[1], line, page, id=f"{name_of(page)}:{line}")


def command_lines():
    for block in blocks("sh"):
        for line in block.values[0].splitlines():
            if line.startswith("motionlabel "):
                yield pytest.param(shlex.split(line, comments=True)[1:], id=line.removeprefix("motionlabel ")[:60])


@pytest.fixture(scope="module")
def folder_of_readme(tmp_path_factory):
    """A place where out/street is labelled, as the README's first command does, only shorter."""
    place = tmp_path_factory.mktemp("readme")
    with contextlib.chdir(place):
        street = "synthetic:street?sweeps=8&seed=1&beams=16&azimuth_steps=450"
        options = ["--dataset", "synthetic", "--output", "out/street", "--points", "--profile", "fast"]
        assert main(["label", street, *options]) == 0
    return place


@pytest.mark.parametrize(("code", "line", "page"), list(blocks("python")))
def test_python_of_the_docs_runs(folder_of_readme, code, line, page):
    with contextlib.chdir(folder_of_readme):
        exec(compile("\n" * (line - 1) + code, str(page), "exec"), {"__name__": "docs"})


@pytest.mark.parametrize("arguments", list(command_lines()))
def test_commands_of_the_docs_parse(arguments):
    path, command = next((path, leaf) for path, leaf in leaves(COMMANDS) if tuple(arguments[: len(path)]) == path)
    context = command.make_context(" ".join(path), arguments[len(path) :])
    for override in context.params.get("overrides") or ():
        key, _, value = override.partition("=")
        resolve_config(overrides={key: value})


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_pictures_exist(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{name_of(page)} points to {target}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_make_targets_exist(page):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z-]+)`|^make ([a-z-]+)", page.read_text(), re.MULTILINE)) <= {
        pair for target in targets for pair in ((target, ""), ("", target))
    }


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_options_named_in_the_text_exist(page):
    known = {"--help"}.union(*(param.opts for _, command in leaves(COMMANDS) for param in command.params))
    named = {span.split()[0] for span in re.findall(r"`(--[^`]+)`", page.read_text())}
    assert named - {"--exclude-editable"} <= known


def test_label_format_describes_every_column():
    text = (ROOT / "docs" / "label_format.md").read_text()
    for table, schema in SCHEMAS.items():
        section = text.partition(f"## {table}\n")[2].partition("\n## ")[0]
        for column in schema.names:
            assert f"`{column}`" in section or column.startswith("visible_"), f"{column} of {table} is not described"


@pytest.mark.parametrize(
    ("page", "schema"), [("open_set.md", merged.SCHEMA), ("trajectories.md", trajectories.make_schema(91))]
)
def test_pages_describe_every_column_of_their_tables(page, schema):
    text = (ROOT / "docs" / page).read_text()
    for column in schema.names:
        assert f"`{column}`" in text, f"{column} is not described"


def test_architecture_names_functions_that_exist():
    text = (ROOT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| \w+ \| `((?:stages|folders)/\w+)\.py` \| `(\w+)` \|", text, re.MULTILINE)
    assert len(rows) == 12
    for path, function in rows:
        assert hasattr(importlib.import_module(f"labeling.{path.replace('/', '.')}"), function), f"{path}: {function}"
