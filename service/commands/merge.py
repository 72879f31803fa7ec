"""`motionlabel merge`: human labels of some categories, auto labels of everything else."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Final

import typer

from labeling.open_set.rule import MAX_SHARE, MIN_OVERLAP, MergeRule, hold_out_rule
from schemas.errors import InvalidInput
from service.exit_codes import DONE, DONE_IN_PART
from service.options import Dataset, LabelsAt, MinTrackScore, OutputFolder, Segments
from service.progress import progress_bar

if TYPE_CHECKING:
    from labeling.open_set.merging import MergeSummary

EPILOG: Final = "Example: motionlabel merge out/labels logs/0a1b --dataset av2 --hold-out vehicle --output out/open-set"


def merge(
    labels: LabelsAt,
    segments: Segments,
    dataset: Dataset,
    output: OutputFolder,
    human: Annotated[
        str | None,
        typer.Option(metavar="CATEGORY[,CATEGORY]", help="What people annotated, as the data set names it."),
    ] = None,
    hold_out: Annotated[
        str | None,
        typer.Option(metavar="KIND", help="vehicle or vru: these from auto labels, the other kind from people."),
    ] = None,
    min_overlap: Annotated[
        float,
        typer.Option(metavar="S", help="Share of the smaller box from which two overlap."),
    ] = MIN_OVERLAP,
    max_share: Annotated[
        float,
        typer.Option(metavar="S", help="Share of an auto track's boxes that may overlap people's."),
    ] = MAX_SHARE,
    min_score: MinTrackScore = None,
) -> int:
    """Join human labels of some categories with auto labels of all else, for detectors of an open set."""
    from labeling.folders.folder import LabelFolder
    from labeling.open_set.merging import merge_labels

    rule = replace(_read_rule(dataset, human, hold_out), min_overlap=min_overlap, max_share=max_share)
    folder = LabelFolder.open(labels)
    with progress_bar() as progress:
        task = progress.add_task("merging", total=len(segments))
        summary = merge_labels(
            folder,
            dataset,
            segments,
            output,
            rule,
            min_score=min_score,
            on_segment=lambda num_done: progress.update(task, completed=num_done),
        )
    return _conclude(summary, output)


def _read_rule(dataset: str, human: str | None, hold_out: str | None) -> MergeRule:
    if (human is None) == (hold_out is None):
        raise InvalidInput("expected either --human CATEGORY[,CATEGORY] or --hold-out vehicle|vru")
    if hold_out is not None:
        return hold_out_rule(dataset, hold_out)
    return MergeRule(frozenset(name.strip() for name in (human or "").split(",")))


def _conclude(summary: "MergeSummary", output: str) -> int:
    """Sum up what was joined, say what was not, and return the exit code."""
    of_people = ", ".join(f"{category} {count}" for category, count in summary.human.items()) or "none"
    typer.echo(
        f"{output}: human boxes: {of_people}; "
        f"auto boxes: {summary.num_auto_boxes} of {summary.num_auto_tracks} tracks; "
        f"dropped: {summary.num_dropped_boxes} of {summary.num_dropped_tracks} tracks of what people labelled "
        f"({summary.num_dropped_apart} overlap no human box); "
        f"files: {summary.num_written} written, {summary.num_kept} already there"
    )
    for segment_id, count in summary.unplaced.items():
        typer.echo(
            f"motionlabel: {segment_id}: {count} human boxes stand in sweeps that were rejected, which have no pose to "
            "place them: they are in no file",
            err=True,
        )
    return DONE_IN_PART if summary.unplaced else DONE
