"""The command line: errors of one line, and exit codes that a script can trust.

0 done, 1 failure, 2 wrong usage or input, 3 done in part (a rejected sweep, a failed fit or segment), 130 interrupted.
Heavy packages are imported inside the commands, so that ``--help`` answers at once.
"""

import json
import os
import time
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from labeling.readers.reader import READERS, open_segment
from schemas.config import PROFILES, LabelingConfig, resolve_config
from schemas.errors import InvalidInput, LabelingError, ShardConflict
from schemas.manifest import Manifest
from service.progress import RunWatcher, progress_bar

DONE: Final = 0
FAILURE: Final = 1
WRONG_INPUT: Final = 2
DONE_IN_PART: Final = 3
INTERRUPTED: Final = 130  # what typer itself returns after Ctrl-C

app = typer.Typer(
    help="Label everything that moves in raw driving LiDAR, without human annotation.",
    epilog="Example: motionlabel demo",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Segments = Annotated[
    list[str],
    typer.Argument(metavar="SEGMENT", help="Folder of one log or drive; or synthetic:street?sweeps=20&seed=1."),
]
Segment = Annotated[str, typer.Argument(metavar="SEGMENT", help="The segment, as it was given to `label`.")]
Dataset = Annotated[str, typer.Option(metavar="NAME", help=f"Data set: {', '.join(READERS)}.")]
LabelsAt = Annotated[str, typer.Argument(metavar="OUT", help="Label folder: a path or s3://bucket/prefix.")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code. Errors are one line on stderr."""
    try:
        code = typer.main.get_command(app).main(arguments, prog_name="motionlabel", standalone_mode=False) or DONE
    except typer.TyperException as error:
        command = getattr(getattr(error, "ctx", None), "command_path", "motionlabel")
        _complain(f"{error.format_message()} (see `{command} --help`)")
        return WRONG_INPUT
    except LabelingError as error:
        _complain(str(error))
        return WRONG_INPUT if isinstance(error, InvalidInput | ShardConflict) else FAILURE
    except OSError as error:
        _complain(str(error))
        return FAILURE
    except Exception as error:  # noqa: BLE001 - the outermost door: no trace unless asked for
        _complain(f"internal error: {type(error).__name__}: {error} (set MOTIONLABEL_DEBUG=1 to see the trace)")
        return FAILURE
    if code == INTERRUPTED:
        _complain("interrupted: finished segments are kept, and the same command goes on from there")
    return int(code)


def _complain(message: str) -> None:
    """Say it in one line; in debug mode the trace of the exception at hand follows."""
    typer.echo(f"motionlabel: {' '.join(message.split())}", err=True)
    if os.environ.get("MOTIONLABEL_DEBUG"):
        typer.echo(traceback.format_exc(), err=True)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"motionlabel {version('motionlabel')}")
        raise typer.Exit


@app.callback()
def options(
    is_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Take the options that belong to no command."""


@app.command(epilog="Example: motionlabel label logs/0a1b --dataset av2 --output out/labels --set flow.iterations=80")
def label(
    segments: Segments,
    dataset: Dataset,
    output: Annotated[str, typer.Option(metavar="OUT", help="Label folder to write: a path or s3://bucket/prefix.")],
    profile: Annotated[str, typer.Option(metavar="NAME", help=f"Parameters: {', '.join(PROFILES)}.")] = "default",
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a parameter, as flow.iterations=80. Repeatable."),
    ] = None,
    sweeps: Annotated[
        str | None, typer.Option(metavar="START:STOP", help="Label these sweeps only; STOP is not included.")
    ] = None,
    points: Annotated[bool, typer.Option("--points", help="Also write flow, cluster and track of each point.")] = False,
    in_process: Annotated[
        bool,
        typer.Option(
            "--in-process", show_default=False, help="Run in this process: the default, and the only way so far."
        ),
    ] = True,
) -> int:
    """Label segments and write a label folder. Segments that are there already are not labelled again."""
    changes = _parse_overrides(overrides or [])
    if sweeps is not None:
        changes["sweeps"] = _parse_sweeps(sweeps)
    if points:
        changes["write_points"] = True
    return _label(dataset, segments, output, resolve_config(profile, changes))


def _parse_overrides(pairs: list[str]) -> dict[str, Any]:  # values are checked by the config
    values: dict[str, Any] = {}
    for pair in pairs:
        key, is_pair, text = pair.partition("=")
        if not is_pair or not key:
            raise InvalidInput(f"--set {pair}: expected KEY=VALUE, as --set flow.iterations=80")
        if key in ("profile", "sweeps", "write_points"):
            option = "points" if key == "write_points" else key
            raise InvalidInput(f"--set {pair}: use the option --{option} instead")
        try:
            values[key] = json.loads(text)
        except json.JSONDecodeError:
            values[key] = text
    return values


def _parse_sweeps(text: str) -> tuple[int, int]:
    start, _, stop = text.partition(":")
    if not (start.isdecimal() and stop.isdecimal() and int(start) < int(stop)):
        raise InvalidInput(f"--sweeps {text}: expected START:STOP with START below STOP, as --sweeps 0:50")
    return int(start), int(stop)


def _label(dataset: str, segments: list[str], output: str, config: LabelingConfig) -> int:
    from labeling.run import label_segments

    with progress_bar() as progress:
        watcher = RunWatcher(progress, len(segments))
        start_s = time.process_time()
        manifest = label_segments(dataset, segments, output, config, on_progress=watcher)
        core_s = time.process_time() - start_s
    _summarize(manifest, output, watcher, core_s)
    for segment in manifest.segments:
        if segment.state != "SUCCEEDED":
            typer.echo(f"motionlabel: {segment.segment_id} {segment.state}: {segment.reason}", err=True)
    states = {segment.state for segment in manifest.segments}
    if states == {"SUCCEEDED"}:
        return DONE
    return FAILURE if states == {"FAILED"} else DONE_IN_PART


def _summarize(manifest: Manifest, output: str, watcher: RunWatcher, core_s: float) -> None:
    labelled = [segment for segment in manifest.segments if segment.state != "FAILED"]
    num_rejected = sum(segment.num_rejected_sweeps for segment in manifest.segments)
    num_sweeps = sum(segment.num_sweeps for segment in labelled)
    num_rows = sum(shard.rows for segment in labelled for shard in segment.shards if shard.table == "labels")
    typer.echo(
        f"{output}: {len(labelled)} of {len(manifest.segments)} segments labelled, {num_sweeps} sweeps "
        f"({num_rejected} rejected), {sum(segment.num_tracks for segment in labelled)} tracks, {num_rows} label rows"
    )
    said = [f"{watcher.num_reused_segments} segments were already there"] if watcher.num_reused_segments else []
    if watcher.num_new_sweeps:
        said.append(f"{core_s / watcher.num_new_sweeps:.2f} core-seconds a sweep")
    if said:
        typer.echo("; ".join(said))


@app.command(epilog="Example: motionlabel render out/labels logs/0a1b --dataset av2 --sweep 10 --png sweep.png")
def render(
    output: LabelsAt,
    segment: Segment,
    dataset: Dataset,
    sweep: Annotated[int, typer.Option(metavar="N", help="Index of the sweep.")],
    png: Annotated[Path, typer.Option(metavar="FILE", help="Picture to write.")],
) -> None:
    """Draw one labelled sweep from above: points by flow, boxes, track ids."""
    from labeling.pictures import render_sweep
    from labeling.shards.folder import LabelFolder

    render_sweep(open_segment(dataset, segment), LabelFolder.open(output), sweep, png)
    typer.echo(f"wrote {png}")
