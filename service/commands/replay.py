"""`motionlabel replay`: a segment's points, boxes and tracks over time, in one page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from labeling.readers.reader import open_segment
from service.options import Dataset, LabelsAt, Segment, require_folder_of
from service.progress import progress_bar

if TYPE_CHECKING:
    from labeling.replay.payload import Json

EPILOG: Final = "Example: motionlabel replay out/labels logs/0a1b --dataset av2 --html replay.html"


def replay(
    labels: LabelsAt,
    segment: Segment,
    dataset: Dataset,
    html: Annotated[Path, typer.Option(metavar="FILE", help="Page to write.")],
    truth: Annotated[bool, typer.Option("--truth", help="Also show the boxes that people made.")] = False,
    max_points: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Points of all sweeps to keep: those that stand still are thinned; by default 4000000.",
        ),
    ] = None,
) -> None:
    """Write a page that shows a segment's points, boxes and tracks in 3D over time. It opens without a network."""
    from labeling.exporters.segments import read_segment
    from labeling.folders.folder import LabelFolder
    from labeling.replay.page import write_replay
    from labeling.replay.payload import MAX_POINTS

    require_folder_of("--html", html)
    folder = LabelFolder.open(labels)
    reader = open_segment(dataset, segment)
    of_segment = read_segment(folder, reader.segment_id, min_score=0.0)
    with progress_bar() as progress:
        task = progress.add_task("writing the page", total=len(of_segment.sweeps))
        told = write_replay(
            html,
            of_segment,
            reader,
            max_points=MAX_POINTS if max_points is None else max_points,
            with_truth=truth,
            on_sweep=lambda num_done: progress.update(task, completed=num_done),
        )
    typer.echo(f"{html}: {_sum_up(told)}, {html.stat().st_size / 1e6:.1f} MB")


def _sum_up(told: "Json") -> str:
    sweeps = told["sweeps"]
    num_kept = sum(sweep["num_static"] + sweep["num_moving"] for sweep in sweeps)
    voxel_m = max(sweep["voxel_m"] for sweep in sweeps)
    thinned = f" (of what stands still, one a voxel of up to {voxel_m:.2f} m)" if voxel_m else ""
    return (
        f"sweeps: {len(sweeps)}, tracks: {len(told['tracks'])}, points: {num_kept} of "
        f"{sum(sweep['num_recorded'] for sweep in sweeps)}{thinned}"
    )
