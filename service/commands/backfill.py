"""`motionlabel backfill`: label all segments of a bucket or a folder through the service."""

import contextlib
import re
from collections import deque
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from labeling.readers.discovery import describe_segments, find_segments, shard_of
from labeling.storage.places import absolute, canonical
from labeling.storage.storage import open_storage
from schemas.api.jobs import SegmentState
from schemas.backfill import BackfillSummary
from schemas.config import resolve_config
from schemas.errors import InvalidInput
from service.commands.jobs import KeyFile, Server, connect
from service.exit_codes import DONE, DONE_IN_PART, FAILURE
from service.ledger import Ledger
from service.options import (
    Dataset,
    Output,
    Overrides,
    Points,
    Profile,
    Sweeps,
    parse_overrides,
    parse_sweeps,
    require_folder_of,
)
from service.progress import count, progress_bar

if TYPE_CHECKING:
    from service.backfill import Backfill, Find, Pace

EPILOG: Final = "Example: motionlabel backfill s3://bucket/drives --dataset av2 --output s3://bucket/labels"
_LINE_EVERY_S: Final = 60.0
_MAX_BATCH: Final = 4000  # segments with the longest names fill the largest body that the service takes


def backfill(
    place: Annotated[str, typer.Argument(metavar="PLACE", help="Where segments lie, at any depth: a folder or s3://.")],
    dataset: Dataset,
    output: Output,
    profile: Profile = "default",
    overrides: Overrides = None,
    sweeps: Sweeps = None,
    points: Points = False,
    priority: Annotated[
        int, typer.Option(metavar="N", min=-100, max=100, help="Jobs of a higher number go first: -100 to 100.")
    ] = 0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be submitted, and submit nothing.")
    ] = False,
    limit: Annotated[int | None, typer.Option(metavar="N", min=1, help="Submit at most N new segments.")] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="Only the I-th of N shares of all segments, 1/N to N/N."),
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(metavar="DATE", help="Only segments with a sweep written since, as 2026-11-28."),
    ] = None,
    batch_size: Annotated[int, typer.Option(metavar="N", min=1, max=_MAX_BATCH, help="Segments a job.")] = 200,
    max_in_flight: Annotated[
        int, typer.Option(metavar="N", min=1, help="Segments that are submitted and not done, at most.")
    ] = 2000,
    retry: Annotated[
        bool, typer.Option("--retry", help="Also run again what earlier runs left without labels.")
    ] = False,
    ledger: Annotated[
        str | None, typer.Option(metavar="PLACE", help="Where to note what was submitted; by default the output.")
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the summary as JSON.")
    ] = None,
    server: Server = None,
    api_key_file: KeyFile = None,
) -> int:
    """Label all segments of a bucket or a folder through the service; once more, it goes on where it stopped.

    Exit code: 0 all of them are labelled, 3 some are, 1 none is.
    """
    from service.backfill import Backfill, Pace

    if batch_size > max_in_flight:
        raise InvalidInput(f"--batch-size {batch_size}: a job has at most --max-in-flight segments, {max_in_flight}")
    if dry_run and (json_path is not None or retry):
        raise InvalidInput("--dry-run submits nothing: there is nothing to --retry, and no --json to write")
    require_folder_of("--json", json_path)
    share, oldest, changes = _parse_shard(shard), _parse_since(since), parse_overrides(overrides or [])
    resolve_config(profile, changes)
    output_uri = canonical(absolute(output))
    template = {
        "dataset": dataset,
        "output_uri": output_uri,
        "profile": profile,
        "overrides": changes,
        "sweeps": None if sweeps is None else parse_sweeps(sweeps),
        "write_points": points,
        "priority": priority,
    }

    def find(on_unusable: Callable[[str], None]) -> Iterator[str]:
        found = find_segments(dataset, place, on_unusable, oldest)
        return found if share is None else (name for name in found if shard_of(dataset, name, share[1]) == share[0])

    _require_any(dataset, place)
    pace = Pace(batch_size, max_in_flight, limit)
    with contextlib.closing(Ledger(open_storage(ledger or output), template, shard or "")) as records:
        if dry_run:
            return _print_new(find, records, pace)
        with connect(server, api_key_file) as client:
            client.get("/v1/status")  # a service that is not there is told before anything is written
            records.prepare()
            run = Backfill(client, records, find, pace, tell=_complain, is_retrying=retry)
            return _conclude(_watch(run, lambda: run.summarize(dataset, place, output_uri), json_path))


def _watch(run: "Backfill", summarize: Callable[[], BackfillSummary], json_path: Path | None) -> BackfillSummary:
    """Run to the end behind a progress bar, in a log with a line a minute. The summary is written in any case."""
    try:
        with progress_bar() as progress:
            task = progress.add_task("", total=None)
            next_line_s = _LINE_EVERY_S
            for _ in run.steps():
                now = summarize()
                progress.update(task, description=_describe(now), completed=now.num_ended, total=now.num_expected)
                if progress.disable and now.elapsed_s >= next_line_s:  # no terminal: a log
                    next_line_s = now.elapsed_s + _LINE_EVERY_S
                    typer.echo(_describe_in_a_log(now), err=True)
    finally:
        if json_path is not None:
            json_path.write_text(summarize().model_dump_json(indent=2) + "\n")
    return summarize()


def _require_any(dataset: str, place: str) -> None:
    unusable: deque[str] = deque(maxlen=1)
    if next(find_segments(dataset, place, unusable.append), None) is None:
        reason = f"; {unusable[0]}" if unusable else ""
        raise InvalidInput(f"{place}: no segment found: {describe_segments(dataset)}{reason}")


def _parse_shard(text: str | None) -> tuple[int, int] | None:
    """Return index, from 0 on, and number of shares."""
    if text is None:
        return None
    match = re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", text, re.ASCII)
    if match is None or int(match[1]) > int(match[2]):
        raise InvalidInput(f"--shard {text}: expected I/N with I from 1 to N, as 1/4 to 4/4 for four shares")
    return int(match[1]) - 1, int(match[2])


def _parse_since(text: str | None) -> datetime | None:
    """Return a moment; UTC where it does not say otherwise."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(f"--since {text}: expected a date as 2026-11-28, or a time as 2026-11-28T06:00Z") from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def _print_new(find: "Find", ledger: Ledger, pace: "Pace") -> int:
    from service.backfill import new_batches

    ledger.read_new()
    num_jobs = num_segments = 0
    for batch in new_batches(find(_complain), ledger, pace):
        num_jobs, num_segments = num_jobs + 1, num_segments + len(batch)
        typer.echo("\n".join(batch))
    typer.echo(f"{count(num_segments, 'segment')} would be submitted, in {count(num_jobs, 'job')}", err=True)
    return DONE


def _describe(summary: BackfillSummary) -> str:
    """Return rate and price; a progress bar says the rest."""
    rate = "" if summary.segments_per_hour is None else f", {summary.segments_per_hour:.0f} segments/h"
    expected = "" if summary.expected_core_hours is None else f" of {summary.expected_core_hours:.2f}"
    return f"{count(summary.num_jobs, 'job')}{rate}, {summary.core_hours:.2f}{expected} core-hours"


def _describe_in_a_log(summary: BackfillSummary) -> str:
    to_go = "" if summary.eta_s is None else f", {timedelta(seconds=round(summary.eta_s))} to go"
    num_expected = "?" if summary.num_expected is None else summary.num_expected
    return f"{summary.num_ended} of {num_expected} segments, {_describe(summary)}{to_go}"


def _conclude(summary: BackfillSummary) -> int:
    """Sum up, and return the exit code."""
    num_labelled = summary.segments[SegmentState.SUCCEEDED]
    others = [
        f"{number} {state}"
        for state, number in summary.segments.items()
        if number and state is not SegmentState.SUCCEEDED
    ]
    others += [f"{summary.num_refused} refused"] * bool(summary.num_refused)
    others += [f"{summary.num_unusable} left out"] * bool(summary.num_unusable)
    typer.echo(
        f"{summary.output_uri}: {num_labelled} of {count(summary.num_segments, 'segment')} labelled, "
        f"in {count(summary.num_jobs, 'job')}" + "".join(f", {other}" for other in others)
    )
    if summary.num_done_before:
        typer.echo(f"{count(summary.num_done_before, 'segment')} labelled before")
    if summary.segments_per_hour is not None:
        typer.echo(f"{summary.segments_per_hour:.0f} segments an hour, {summary.core_hours:.2f} core-hours")
    if not others:
        return DONE
    is_any = num_labelled + summary.num_done_before + summary.segments[SegmentState.PARTIAL]
    return DONE_IN_PART if is_any else FAILURE


def _complain(message: str) -> None:
    typer.echo(f"motionlabel: {message}", err=True)
