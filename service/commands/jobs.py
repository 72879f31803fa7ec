"""`motionlabel submit | status | watch | cancel | retry`: thin clients of the API."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import typer
from pydantic import BaseModel

from labeling.storage.places import absolute
from schemas.api.jobs import MAX_DEADLINE_S, JobPage, JobState, JobStatus, SegmentPage, SegmentState
from schemas.api.status import ServiceStatus
from schemas.errors import InvalidInput
from service.exit_codes import DONE, DONE_IN_PART, FAILURE
from service.options import (
    Dataset,
    Output,
    Overrides,
    Points,
    Profile,
    Segments,
    Sweeps,
    parse_overrides,
    parse_sweeps,
)
from service.progress import progress_bar
from service.settings import read_settings

if TYPE_CHECKING:
    from service.client import Client

M = TypeVar("M", bound=BaseModel)
POLL_S: Final = 1.0
_PATIENCE: Final = 30  # polls in a row that may fail while the service starts anew
_TROUBLED: Final = (SegmentState.PARTIAL, SegmentState.FAILED, SegmentState.CRASHED)
_MAX_LISTED: Final = 20  # lines of jobs or of troubled segments

Server = Annotated[
    str | None, typer.Option(metavar="URL", help="The service; by default MOTIONLABEL_SERVER or http://127.0.0.1:8000.")
]
KeyFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="File that holds your API key; by default MOTIONLABEL_API_KEY is it, if set."),
]
Job = Annotated[str, typer.Argument(metavar="JOB", help="Id of the job, as `submit` prints it.")]


def submit(
    segments: Segments,
    dataset: Dataset,
    output: Output,
    profile: Profile = "default",
    overrides: Overrides = None,
    sweeps: Sweeps = None,
    points: Points = False,
    priority: Annotated[int, typer.Option(metavar="N", help="Jobs of a higher number go first: -100 to 100.")] = 0,
    deadline_s: Annotated[float | None, typer.Option(metavar="S", help="Stop the job after this many seconds.")] = None,
    client_job_id: Annotated[
        str | None, typer.Option(metavar="ID", help="Your name for the job: submitting it again changes nothing.")
    ] = None,
    server: Server = None,
    api_key_file: KeyFile = None,
) -> None:
    """Hand segments to the service and print the job's id."""
    if deadline_s is not None and not 0 < deadline_s <= MAX_DEADLINE_S:
        raise InvalidInput(f"--deadline-s {deadline_s:g}: expected seconds above 0 and up to {MAX_DEADLINE_S:g}")
    body: dict[str, Any] = {
        "dataset": dataset,
        "segments": [absolute(segment) for segment in segments],
        "output_uri": absolute(output),
        "profile": profile,
        "overrides": parse_overrides(overrides or []),
        "sweeps": None if sweeps is None else parse_sweeps(sweeps),
        "write_points": points,
        "priority": priority,
        "deadline_s": deadline_s,
        "client_job_id": client_job_id,
    }
    with connect(server, api_key_file) as client:
        typer.echo(_read_job(client.post("/v1/jobs", body)).id)


def status(
    job: Annotated[str | None, typer.Argument(metavar="[JOB]", help="Id of a job; none: the whole service.")] = None,
    server: Server = None,
    api_key_file: KeyFile = None,
) -> int:
    """Show how a job stands, or the service and its latest jobs. The exit code of an ended job is that of `watch`."""
    with connect(server, api_key_file) as client:
        if job is None:
            _show_service(client)
            return DONE
        found = _get_job(client, job)
        _show_job(client, found)
        return _exit_code(found.state)


def watch(job: Job, server: Server = None, api_key_file: KeyFile = None) -> int:
    """Wait for a job with a progress bar. Exit code: 0 succeeded, 3 partial, 1 any other end."""
    with connect(server, api_key_file) as client, progress_bar() as progress:
        task = progress.add_task(job, total=100)
        for found in _poll(client, job):
            ended = sum(count for state, count in found.segments.items() if state.is_ended)
            description = f"{found.id} {found.state} [{ended}/{found.num_segments}]"
            progress.update(task, completed=int(100 * found.progress), description=description)
        progress.stop()
        _show_job(client, found)
    return _exit_code(found.state)


def cancel(job: Job, server: Server = None, api_key_file: KeyFile = None) -> None:
    """Stop a job. What is labelled stays readable."""
    with connect(server, api_key_file) as client:
        _show_job(client, _read_job(client.post(_path(job, ":cancel"))))


def retry(job: Job, server: Server = None, api_key_file: KeyFile = None) -> None:
    """Run what failed, crashed or was cancelled in a job again."""
    with connect(server, api_key_file) as client:
        _show_job(client, _read_job(client.post(_path(job, ":retry"))))


def connect(server: str | None, api_key_file: Path | None) -> "Client":
    """Return the service's client, with the caller's API key if there is one.

    Raises:
        InvalidInput: As ``Client``, or the file of the key cannot be read.

    """
    from service.client import Client

    settings = read_settings(server=server, api_key_file=api_key_file)
    path = settings.api_key_file
    return Client(settings.server, settings.api_key.get_secret_value() if path is None else _read_token(path))


def _read_token(path: Path) -> str:
    try:
        token = path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise InvalidInput(f"cannot read the API key {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        token = ""
    if not token:
        raise InvalidInput(f"{path} holds no API key: expected one line, ml_...")
    return token


def _path(job: str, rest: str = "") -> str:
    if not (job.isascii() and job.isalnum()):
        raise InvalidInput(f"{job!r} is not the id of a job: expected what `motionlabel submit` prints")
    return f"/v1/jobs/{job}{rest}"


def _get_job(client: "Client", job: str) -> JobStatus:
    return _read_job(client.get(_path(job)))


def _read_job(answer: Any) -> JobStatus:
    return _read(JobStatus, answer)


def _read(model: type[M], answer: Any) -> M:
    from service.client import read_answer

    return read_answer(model, answer)


def _poll(client: "Client", job: str) -> Iterator[JobStatus]:
    """Yield the job until it has ended. A service that starts anew is waited for."""
    from service.client import ServiceError

    found = _get_job(client, job)
    num_failed = 0
    while not found.state.is_ended:
        yield found
        time.sleep(POLL_S)
        try:
            found = _get_job(client, job)
            num_failed = 0
        except ServiceError:
            num_failed += 1
            if num_failed == _PATIENCE:
                raise
    yield found


def _exit_code(state: JobState) -> int:
    if state is JobState.PARTIAL:
        return DONE_IN_PART
    return FAILURE if state.is_ended and state is not JobState.SUCCEEDED else DONE


def _show_job(client: "Client", job: JobStatus) -> None:
    counts = ", ".join(f"{count} {state}" for state, count in job.segments.items() if count)
    eta = "" if job.eta_s is None or job.state.is_ended else f", {job.eta_s:.0f} s to go"
    typer.echo(f"{job.id} {job.state} {job.progress:.0%}{eta}: {counts}; labels: {job.output_uri}")
    if job.failure is not None:
        typer.echo(f"motionlabel: {job.failure.error}: {job.failure.message}", err=True)
    for state in _TROUBLED:
        if job.segments.get(state):
            answer = client.get(_path(job.id, "/segments"), state=state, page_size=_MAX_LISTED)
            for segment in _read(SegmentPage, answer).segments:
                reason = f": {segment.failure.message}" if segment.failure else ""
                typer.echo(f"motionlabel: {segment.uri} {segment.state}{reason}", err=True)
            if job.segments[state] > _MAX_LISTED:
                typer.echo(f"motionlabel: and {job.segments[state] - _MAX_LISTED} more {state}", err=True)


def _show_service(client: "Client") -> None:
    service = _read(ServiceStatus, client.get("/v1/status"))
    counts = ", ".join(f"{count} {state}" for state, count in service.jobs.items() if count)
    fresh = [dispatcher for dispatcher in service.dispatchers if dispatcher.is_fresh]
    workers = sum(dispatcher.num_workers for dispatcher in fresh)
    typer.echo(f"jobs: {counts or 'none'}")
    typer.echo(f"segments: {service.running_segments} running, {service.queued_segments} waiting")
    typer.echo(f"dispatchers: {len(fresh)}, workers: {workers}")
    for job in _read(JobPage, client.get("/v1/jobs", page_size=_MAX_LISTED)).jobs:
        typer.echo(f"{job.id} {job.state} {job.progress:.0%} {job.dataset} {job.output_uri}")
