"""`motionlabel export`: labels in the formats of other tools."""

from collections.abc import Iterable
from typing import Annotated, Final

import typer

from labeling.exporters.exporter import EXPORTERS, ExportOptions, ExportSummary, export_labels, require_options
from service.exit_codes import DONE, DONE_IN_PART
from service.options import LabelsAt, OutputFolder
from service.progress import progress_bar

EPILOG: Final = "Example: motionlabel export out/labels --format av2 --output out/av2\n\n\b\nFormats:\n" + "\n".join(
    f"  {name:<14} {known.content}" for name, known in EXPORTERS.items()
)


def export(
    labels: LabelsAt,
    format_name: Annotated[str, typer.Option("--format", metavar="NAME", help=f"One of {', '.join(EXPORTERS)}.")],
    output: OutputFolder,
    min_score: Annotated[
        float | None, typer.Option(metavar="S", help="Score cut; by default the one the labels recommend.")
    ] = None,
    category: Annotated[
        str | None, typer.Option(metavar="NAME", help="The format's name of all objects; by default by their size.")
    ] = None,
    calibration: Annotated[
        str | None, typer.Option(metavar="PATH", help="For kitti: calib/SEQ.txt, or the folder of a raw date.")
    ] = None,
    voxel_m: Annotated[
        float | None, typer.Option(metavar="M", help="For map: edge of the voxels, m; by default 0.1.")
    ] = None,
    cloud: Annotated[str | None, typer.Option(metavar="NAME", help="For map: ply, the default, or pcd.")] = None,
) -> int:
    """Write labels in the format of another tool. What is there already is not written again, and never replaced."""
    options = ExportOptions(min_score, category, calibration, voxel_m, cloud)
    require_options(format_name, options)
    from labeling.folders.folder import LabelFolder

    folder = LabelFolder.open(labels)
    with progress_bar() as progress:
        task = progress.add_task(f"exporting to {format_name}", total=len(folder.entries))
        summary = export_labels(
            folder,
            format_name,
            output,
            options,
            on_segment=lambda num_done: progress.update(task, completed=num_done),
        )
    return _conclude(summary, output)


def _conclude(summary: ExportSummary, output: str) -> int:
    """Sum up what was exported, say what was not, and return the exit code."""
    typer.echo(
        f"{output}: boxes: {summary.num_boxes}, sweeps: {summary.num_sweeps} ({summary.num_rejected_sweeps} rejected), "
        f"segments: {summary.num_segments}; "
        f"files: {summary.num_written} written, {summary.num_kept} already there"
    )
    return tell_of_failed(summary.segments_without_labels)


def tell_of_failed(segment_ids: Iterable[str]) -> int:
    """Name the segments that have no labels to write, and return the exit code."""
    code = DONE
    for segment_id in segment_ids:
        code = DONE_IN_PART
        typer.echo(f"motionlabel: {segment_id} has no labels: it failed, and label says why", err=True)
    return code
