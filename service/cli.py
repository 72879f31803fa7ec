"""The command line: errors of one line, and exit codes that a script can trust.

0 done, 1 failure, 2 wrong usage or input, 3 done in part (a rejected sweep, a failed fit or segment), 130 interrupted.
Heavy packages are imported inside the commands, so that ``--help`` answers at once.
"""

import logging
import sys
import time
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from labeling.readers.reader import SegmentReader, open_segment
from schemas.config import LabelingConfig, resolve_config
from schemas.errors import InvalidInput, LabelingError, ShardConflict, shorten
from service.commands import ablate, backfill, export, folders, jobs, keys, merge, replay, serving, trajectories
from service.exit_codes import DONE, DONE_IN_PART, FAILURE, INTERRUPTED, WRONG_INPUT
from service.options import (
    Dataset,
    LabelsAt,
    Output,
    Overrides,
    Points,
    Profile,
    Segment,
    Segments,
    Sweeps,
    parse_overrides,
    parse_sweeps,
    refuse_empty_output,
    require_folder_of,
)
from service.progress import RunWatcher, count, progress_bar
from service.settings import is_debugging
from service.signals import ended_by_signals

if TYPE_CHECKING:
    from labeling.evaluation.report import Report
    from schemas.manifest import Manifest

_RESUMABLE: Final = ("label", "backfill", "demo")

app = typer.Typer(
    help="Label everything that moves in raw driving LiDAR, without human annotation.",
    epilog="Example: motionlabel demo",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code. Errors are one line on stderr."""
    if is_debugging():
        logging.basicConfig(format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("labeling").setLevel(logging.DEBUG if is_debugging() else logging.NOTSET)
    try:
        with ended_by_signals():
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
        _complain(
            f"internal error: {type(error).__name__}: {shorten(str(error))} (set MOTIONLABEL_DEBUG=1 to see the trace)"
        )
        return FAILURE
    if code == INTERRUPTED:
        command = next(iter(sys.argv[1:] if arguments is None else arguments), "")
        is_resumed = command in _RESUMABLE
        _complain(
            "interrupted" + (": finished segments are kept, and the same command goes on from there" * is_resumed)
        )
    return int(code)


def _complain(message: str) -> None:
    """Say it in one line; in debug mode the trace of the exception at hand follows."""
    typer.echo(f"motionlabel: {' '.join(message.split())}", err=True)
    if is_debugging():
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
    output: Output,
    profile: Profile = "default",
    overrides: Overrides = None,
    sweeps: Sweeps = None,
    points: Points = False,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Fit flow in N worker processes, and prepare sweeps beside them."),
    ] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Run in this process alone: the default without --workers.")
    ] = False,
) -> int:
    """Label segments and write a label folder. Segments that are there already are not labelled again."""
    if in_process and workers is not None:
        raise InvalidInput("--in-process and --workers exclude each other")
    changes = parse_overrides(overrides or [])
    if sweeps is not None:
        changes["sweeps"] = parse_sweeps(sweeps)
    if points:
        changes["write_points"] = True
    return _label(dataset, segments, output, resolve_config(profile, changes), workers)


def _label(
    dataset: str, segments: list[str], output: str, config: LabelingConfig, num_workers: int | None = None
) -> int:
    with progress_bar() as progress:
        watcher = RunWatcher(progress, len(segments))
        if num_workers is None:
            from labeling.in_process import label_in_process
            from labeling.run import label_segments

            start_s = time.process_time()
            manifest = label_segments(dataset, segments, output, config, label_in_process, on_progress=watcher)
            core_s = time.process_time() - start_s
        else:
            from workers.local import label_segments_on_ray

            manifest, core_s = label_segments_on_ray(
                dataset, segments, output, config, num_workers=num_workers, on_progress=watcher
            )
    return _conclude(manifest, output, watcher, core_s)


def _label_by_service(dataset: str, segments: list[str], output: Path, config: LabelingConfig) -> int:
    from service.local_service import label_segments_by_service

    with progress_bar() as progress:
        watcher = RunWatcher(progress, len(segments))
        manifest, core_s = label_segments_by_service(dataset, segments, output, config, on_progress=watcher)
    return _conclude(manifest, str(output), watcher, core_s)


def _conclude(manifest: "Manifest", output: str, watcher: RunWatcher, core_s: float) -> int:
    """Sum up what was labelled, say what was not, and return the exit code."""
    _summarize(manifest, output, watcher, core_s)
    for segment in manifest.segments:
        if segment.state != "SUCCEEDED":
            typer.echo(f"motionlabel: {segment.segment_id} {segment.state}: {segment.reason}", err=True)
    states = {segment.state for segment in manifest.segments}
    if states == {"SUCCEEDED"}:
        return DONE
    return FAILURE if states == {"FAILED"} else DONE_IN_PART


def _summarize(manifest: "Manifest", output: str, watcher: RunWatcher, core_s: float) -> None:
    labelled = [segment for segment in manifest.segments if segment.state != "FAILED"]
    num_rejected = sum(segment.num_rejected_sweeps for segment in manifest.segments)
    num_rows = sum(shard.rows for segment in labelled for shard in segment.shards if shard.table == "labels")
    typer.echo(
        f"{output}: {len(labelled)} of {count(len(manifest.segments), 'segment')} labelled, "
        f"{count(sum(segment.num_sweeps for segment in labelled), 'sweep')} ({num_rejected} rejected), "
        f"{count(sum(segment.num_tracks for segment in labelled), 'track')}, {count(num_rows, 'label row')}"
    )
    num_reused = watcher.num_reused_segments
    if num_reused:
        typer.echo(f"{count(num_reused, 'segment')} {'was' if num_reused == 1 else 'were'} already there")
    if watcher.num_new_sweeps:
        typer.echo(f"{core_s / watcher.num_new_sweeps:.2f} core-seconds a sweep")


@app.command(epilog="Example: motionlabel evaluate out/labels logs/0a1b --dataset av2 --json report.json")
def evaluate(
    output: LabelsAt,
    segments: Segments,
    dataset: Dataset,
    azimuth_deg: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Only within this angle of straight ahead, for logs annotated there only."),
    ] = None,
    min_score: Annotated[
        float | None, typer.Option(metavar="S", help="Score cut; by default the one the labels recommend.")
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures as JSON.")
    ] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Also draw the figures, as one picture.")] = None,
) -> None:
    """Judge labels against annotations: flow, static points, boxes, tracks."""
    if azimuth_deg is not None and not 0 < azimuth_deg <= 180:
        raise InvalidInput(f"--azimuth-deg {azimuth_deg:g}: expected degrees above 0 and up to 180")
    if min_score is not None and not 0 <= min_score <= 1:
        raise InvalidInput(f"--min-score {min_score:g}: expected a score between 0 and 1")
    require_folder_of("--json", json_path)
    require_folder_of("--png", png)
    if png is not None and png.suffix.lower() != ".png":
        raise InvalidInput(f"--png {png}: expected a name that ends in .png")
    report = _evaluate(output, [open_segment(dataset, segment) for segment in segments], azimuth_deg, min_score)
    if json_path is not None:
        json_path.write_text(report.model_dump_json(indent=2) + "\n")
    if png is not None:
        from labeling.evaluation.plots import render_report

        render_report(report, png)


def _evaluate(
    output: str, readers: list[SegmentReader], azimuth_deg: float | None = None, min_score: float | None = None
) -> "Report":
    from labeling.evaluation.report import PASSES, evaluate_segments
    from labeling.evaluation.tables import render_table
    from labeling.folders.folder import LabelFolder

    folder = LabelFolder.open(output)
    with progress_bar() as progress:
        task = progress.add_task("evaluating", total=PASSES * sum(len(reader.timestamps_ns) for reader in readers))
        report = evaluate_segments(
            folder,
            readers,
            azimuth_deg=azimuth_deg,
            min_score=min_score,
            progress=lambda done: progress.update(task, completed=done),
        )
    typer.echo(render_table(report), nl=False)
    return report


@app.command(epilog="Example: motionlabel render out/labels logs/0a1b --dataset av2 --sweep 10 --png sweep.png")
def render(
    output: LabelsAt,
    segment: Segment,
    dataset: Dataset,
    sweep: Annotated[int, typer.Option(metavar="N", help="Index of the sweep.")],
    png: Annotated[Path, typer.Option(metavar="FILE", help="Picture to write.")],
) -> None:
    """Draw one labelled sweep from above: points by flow, boxes, track ids."""
    _render(output, open_segment(dataset, segment), sweep, png)


def _render(output: str, reader: SegmentReader, sweep: int, png: Path) -> None:
    from labeling.folders.folder import LabelFolder
    from labeling.pictures import render_sweep

    render_sweep(reader, LabelFolder.open(output), sweep, png)
    typer.echo(f"picture: {png}")


@app.command(epilog="Example: motionlabel demo --output out/demo --sweeps 20 --seed 1")
def demo(
    output: Annotated[
        str, typer.Option(metavar="OUT", help="Label folder to write.", callback=refuse_empty_output)
    ] = "out/demo",
    sweeps: Annotated[int, typer.Option(min=2, help="Length of the street's recording.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Another seed is another street.")] = 1,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Label in this process alone, without the service.")
    ] = False,
) -> int:
    """Start the service, have it label a built-in street, stop it; judge the labels and draw a picture."""
    segment = f"synthetic:street?sweeps={sweeps}&seed={seed}"
    config = resolve_config(overrides={"write_points": True})
    if in_process:
        code = _label("synthetic", [segment], output, config)
    else:
        code = _label_by_service("synthetic", [segment], Path(output), config)
    if code != FAILURE:
        reader = open_segment("synthetic", segment)
        typer.echo()
        _evaluate(output, [reader])
        typer.echo()
        _render(output, reader, sweeps // 2, Path(output) / "picture.png")
        typer.echo(f"shards:  {output}/labels, {output}/sweeps, {output}/points")
    return code


app.command(epilog="Example: motionlabel init-folder logs/tuesday")(folders.init_folder)
app.command(epilog=export.EPILOG)(export.export)
app.command(epilog=merge.EPILOG)(merge.merge)
app.command(epilog=trajectories.EPILOG)(trajectories.trajectories)
app.command(epilog=replay.EPILOG)(replay.replay)
app.command(epilog="Example: motionlabel submit 'synthetic:street?sweeps=20' --dataset synthetic --output out/street")(
    jobs.submit
)
app.command(epilog="Example: motionlabel status 9f2c61d04b7e8a35")(jobs.status)
app.command(epilog="Example: motionlabel watch 9f2c61d04b7e8a35")(jobs.watch)
app.command(epilog="Example: motionlabel cancel 9f2c61d04b7e8a35")(jobs.cancel)
app.command(epilog="Example: motionlabel retry 9f2c61d04b7e8a35")(jobs.retry)
app.command(epilog=backfill.EPILOG)(backfill.backfill)
app.command(epilog=serving.EPILOG)(serving.serve)
app.command(epilog="Example: motionlabel dispatch --workers 8")(serving.dispatch)
app.command(epilog="Example: motionlabel migrate --data-dir data")(serving.migrate)
app.add_typer(ablate.app, name="ablate")
app.add_typer(keys.app, name="key")
