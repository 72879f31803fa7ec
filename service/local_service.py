"""A service of one's own: `motionlabel serve` as a child, up for one run, down after it, with nothing left behind."""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from labeling.folders.entries import failed_entry
from labeling.readers.reader import SegmentReader
from labeling.run import OnProgress, RunProgress, Stage, label_segments
from labeling.storage.storage import Storage
from schemas.api.jobs import JobStatus, SegmentPage, SegmentState, SegmentStatus
from schemas.api.labels import JobLabels
from schemas.config import LabelingConfig
from schemas.manifest import Manifest, SegmentEntry
from service.client import Client, ServiceError
from service.signals import ended_by_signals
from workers.processes import CpuMeter

_POLL_S: Final = 0.3
_READY_S: Final = 180.0  # a slow and busy machine needs a minute to start Ray
_STOP_S: Final = 30.0  # serve itself kills what takes longer than 10 s
_COMMAND: Final = (sys.executable, "-P", "-m", "service", "serve", "--port", "0")  # -P: modules of its folder stay out
_KEPT: Final = "MOTIONLABEL_DEBUG"


def label_segments_by_service(
    dataset: str,
    uris: Sequence[str],
    output: Path,
    config: LabelingConfig,
    *,
    on_progress: OnProgress = lambda _: None,
) -> tuple[Manifest, float]:
    """Label segments as one job of a service that is started for it, unless all are labelled already.

    The service may read and write below the folder that ``output`` lies in. The shards are the same as any way.

    Returns:
        The manifest, and the core-seconds of all processes of the service.

    Raises:
        InvalidInput: As ``labeling.run.label_segments``.
        ServiceError: The service did not get ready, or ended before the job did.

    """
    core_s = 0.0

    def label_readers(
        readers: Sequence[SegmentReader], storage: Storage, config: LabelingConfig, on_progress: OnProgress
    ) -> Iterator[SegmentEntry]:
        nonlocal core_s
        if not readers:
            return
        meter = CpuMeter()

        def watch(step: RunProgress) -> None:
            nonlocal core_s
            core_s = meter.read_core_s()
            on_progress(step)

        place = output.expanduser().resolve()
        with local_service(place.parent) as url, Client(url) as client:
            yield from _run_job(client, readers, place, config, watch)

    manifest = label_segments(dataset, uris, output, config, label_readers, on_progress=on_progress)
    return manifest, core_s


def make_request(dataset: str, uris: Sequence[str], output: Path, config: LabelingConfig) -> dict[str, Any]:
    """Return the body of the job that labels with exactly this config."""
    values = config.model_dump(mode="json")
    fields = {name: values.pop(name) for name in ("profile", "sweeps", "write_points")}
    return {"dataset": dataset, "segments": list(uris), "output_uri": str(output), "overrides": values, **fields}


def _run_job(
    client: Client, readers: Sequence[SegmentReader], output: Path, config: LabelingConfig, on_progress: OnProgress
) -> Iterator[SegmentEntry]:
    """Submit, watch, and yield the entries of all segments when the job has ended."""
    followed = {reader.uri: _Followed(reader, on_progress) for reader in readers}
    job = JobStatus.model_validate(
        client.post("/v1/jobs", make_request(readers[0].dataset, list(followed), output, config)), strict=False
    )
    path = f"/v1/jobs/{job.id}"
    while not job.state.is_ended:
        time.sleep(_POLL_S)
        job = JobStatus.model_validate(client.get(path), strict=False)
        segments = SegmentPage.model_validate(client.get(f"{path}/segments", page_size=len(readers)), strict=False)
        for segment in segments.segments:
            followed[segment.uri].tell(segment)
    entries = {}
    if job.segments[SegmentState.SUCCEEDED] or job.segments[SegmentState.PARTIAL]:
        labels = JobLabels.model_validate(client.get(f"{path}/labels"), strict=False)
        entries = {entry.segment_id: entry for entry in labels.segments}
    for segment in segments.segments:
        reader = followed[segment.uri].reader
        failure = segment.failure or job.failure
        reason = failure.message if failure else f"the job ended {job.state}"
        yield entries.get(reader.segment_id) or failed_entry(reader.segment_id, reader.uri, reason)


class _Followed:
    """A segment of the job, and how far it was told to be."""

    def __init__(self, reader: SegmentReader, on_progress: OnProgress) -> None:
        self.reader = reader
        self._on_progress = on_progress
        self._sweeps_done = -1
        self._is_ended = False

    def tell(self, segment: SegmentStatus) -> None:
        """Pass on what is new, each sweep once."""
        num_sweeps = segment.num_sweeps or len(self.reader.timestamps_ns)
        for done in range(self._sweeps_done + 1, segment.sweeps_done + 1):
            self._on_progress(RunProgress(self.reader.segment_id, "sweeps", done, num_sweeps))
        self._sweeps_done = max(self._sweeps_done, segment.sweeps_done)
        stage: Stage = "finished" if segment.state.is_ended else "tracks"
        if not self._is_ended and (segment.state.is_ended or segment.stage == "tracks"):
            self._on_progress(RunProgress(self.reader.segment_id, stage, self._sweeps_done, num_sweeps))
        self._is_ended = segment.state.is_ended


@contextmanager
def local_service(data_root: Path, command: Sequence[str] = _COMMAND, *, ready_s: float = _READY_S) -> Iterator[str]:
    """Run a service on a free port of this machine; yield its URL when it is ready for jobs.

    It keeps its store in a temporary folder, and heeds no setting of the environment. Whatever ends the block, also
    Ctrl-C, SIGTERM or SIGHUP, takes it down, and all that it started.

    Args:
        data_root: The one folder that its jobs may read and write below.
        command: That serves; must say on stdout where, and take ``--parent-pid``.
        ready_s: How long it may take to get ready.

    Raises:
        ServiceError: It did not get ready.

    """
    variables = {
        name: text for name, text in os.environ.items() if not name.startswith("MOTIONLABEL_") or name == _KEPT
    }
    with (
        tempfile.TemporaryDirectory(prefix="motionlabel-service-", ignore_cleanup_errors=True) as folder,
        ended_by_signals(),
    ):
        variables["MOTIONLABEL_DATA_DIR"] = folder
        said, log = Path(folder, "stdout"), Path(folder, "stderr")
        with said.open("wb") as stdout, log.open("wb") as stderr:
            process = subprocess.Popen(
                [*command, "--parent-pid", str(os.getpid())],  # not even kill -9 of this process leaves it behind
                cwd=data_root,  # by default the data root
                env=variables,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                start_new_session=True,  # Ctrl-C is ours: serve hears of it from us, once
            )
        try:
            yield _wait_until_ready(process, said, log, ready_s)
        finally:
            _stop(process)


def _wait_until_ready(process: "subprocess.Popen[bytes]", said: Path, log: Path, ready_s: float) -> str:
    deadline_s = time.monotonic() + ready_s
    while time.monotonic() < deadline_s:
        has_ended = process.poll() is not None
        if url := re.search(r"^motionlabel serves (\S+) ", said.read_text()):
            return url[1]
        if has_ended:
            raise ServiceError(f"the service ended with exit code {process.returncode}{_last_words(log)}")
        time.sleep(0.1)
    raise ServiceError(f"the service was not ready for jobs within {ready_s:g} s{_last_words(log)}")


def _last_words(log: Path) -> str:
    """Return what the service complained about last: an error if there is one."""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    chosen = [line for line in lines if re.search(r"Error\b|\bERROR\b", line)] or lines
    return f": {chosen[-1].strip()}" if chosen else ""


def _stop(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    finally:
        process.kill()  # nothing to do when it has ended
        process.wait()
