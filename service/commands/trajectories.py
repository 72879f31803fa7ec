"""`motionlabel trajectories`: where objects came from and where they go."""

from typing import Annotated, Final

import typer

from service.commands.export import tell_of_failed
from service.options import LabelsAt, MinTrackScore, OutputFolder
from service.progress import progress_bar

EPILOG: Final = (
    "Example: motionlabel trajectories out/labels --output out/trajectories\n\n\b\nFormats:\n"
    "  parquet        windows around anchors, each in the frame that its object has there\n"
    "  scenarionet    a scenario a segment, for MetaDrive and ScenarioNet"
)


def trajectories(
    labels: LabelsAt,
    output: OutputFolder,
    format_name: Annotated[str, typer.Option("--format", metavar="NAME", help="parquet or scenarionet.")] = "parquet",
    hz: Annotated[float | None, typer.Option(metavar="HZ", help="Steps a second; by default 10.")] = None,
    step_s: Annotated[
        float | None, typer.Option(metavar="S", help="From one anchor to the next, s; by default 0.5.")
    ] = None,
    history_s: Annotated[float | None, typer.Option(metavar="S", help="Before an anchor, s; by default 1.")] = None,
    future_s: Annotated[float | None, typer.Option(metavar="S", help="After an anchor, s; by default 8.")] = None,
    max_gap_s: Annotated[
        float | None, typer.Option(metavar="S", help="Longest time between boxes that is bridged, s; by default 0.55.")
    ] = None,
    min_score: MinTrackScore = None,
) -> int:
    """Write histories and futures of all objects. What is there already is not written again, and never replaced."""
    from labeling.folders.folder import LabelFolder
    from labeling.trajectories.trajectories import FORMATS, MAX_GAP_S, make_horizon, write_trajectories

    chosen = {"hz": hz, "step_s": step_s, "history_s": history_s, "future_s": future_s}
    horizon = make_horizon(format_name, {name: value for name, value in chosen.items() if value is not None})
    folder = LabelFolder.open(labels)
    with progress_bar() as progress:
        task = progress.add_task("writing trajectories", total=len(folder.entries))
        summary = write_trajectories(
            folder,
            output,
            horizon,
            format_name=format_name,
            max_gap_s=MAX_GAP_S if max_gap_s is None else max_gap_s,
            min_score=min_score,
            on_segment=lambda num_done: progress.update(task, completed=num_done),
        )
    typer.echo(
        f"{output}: {FORMATS[format_name].unit}: {summary.num_units}, tracks: {summary.num_tracks}, gaps that are not "
        f"bridged: {summary.num_gaps}, segments: {summary.num_segments}; files: {summary.num_written} written, "
        f"{summary.num_kept} already there"
    )
    return tell_of_failed(folder.segments_without_labels)
