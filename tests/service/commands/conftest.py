"""What `backfill` runs against: a real server on this machine, and a dispatcher that is played, in made-up time."""

import pytest
from sqlalchemy import func, select

from labeling.storage.storage import open_storage
from schemas.api.jobs import Failure, SegmentState
from schemas.manifest import SegmentEntry, Shard
from service.client import Client
from workers.jobs.claims import Dispatcher
from workers.jobs.tables import jobs, segments

LOGS = (*(f"train/log{k}" for k in range(5)), "val/deep/log5", "val/log6")
NUM_CPUS = 2


class Service:
    """A dispatcher of two CPUs: whenever ``backfill`` waits, it ends what it had at work and begins what it can."""

    def __init__(self, queue, end_jobs):
        self._queue, self._end_jobs = queue, end_jobs
        self._claims = []
        self.now_s = 0.0  # by the clock of ``backfill``
        self.num_waits = 0
        self.num_cpus = NUM_CPUS
        self.states = {}  # of segments by their last names; others are SUCCEEDED
        self.before_wait = lambda: None

    def monotonic(self):
        return self.now_s

    def sleep(self, seconds):
        self.before_wait()
        self.now_s += seconds
        self.num_waits += 1
        self._queue.heartbeat(Dispatcher(id="d", host="h", pid=1, code_version="1", num_workers=self.num_cpus))
        for claim in self._claims:
            self._finish(claim)
        waiting = (self._queue.claim_segment("d", lease_s=600) for _ in range(self.num_cpus))
        self._claims = [claim for claim in waiting if claim is not None]
        self._end_jobs()

    def _finish(self, claim):
        state = SegmentState(self.states.get(claim.uri.rpartition("/")[2], "SUCCEEDED"))
        if state in ("FAILED", "CRASHED"):
            self._queue.finish(claim, state, failure=Failure(error="InvalidInput", message="no sweeps"))
        else:
            shard = Shard(table="labels", path="labels/x.parquet", rows=7, bytes=100, sha256="0" * 64)
            self._queue.finish(
                claim, state, entry=SegmentEntry(segment_id="x", uri=claim.uri, state=state, shards=(shard,))
            )

    def count(self, output):
        """How often each segment was submitted for an output."""
        query = select(segments.c.uri, func.count()).join(jobs).where(jobs.c.output_uri == str(output))
        with self._queue._database.read() as connection:
            return dict(connection.execute(query.group_by(segments.c.uri)).all())

    def num_in_flight(self):
        with self._queue._database.read() as connection:
            is_open = segments.c.state.in_((SegmentState.QUEUED, SegmentState.RUNNING))
            return connection.execute(select(func.count()).where(is_open)).scalar_one()


@pytest.fixture
def service(server, queue, end_jobs, monkeypatch):
    service = Service(queue, end_jobs)
    monkeypatch.setattr("service.backfill.time", service)
    return service


@pytest.fixture
def root(settings):
    return settings.data_roots[0]


@pytest.fixture
def place(root):
    """Seven logs at two depths, of which nothing but the folders are there: nobody opens them."""
    for name in LOGS:
        open_storage(f"{root}/drives").prepare((f"{name}/sensors/lidar",))
    return f"{root}/drives"


@pytest.fixture
def names(place):
    return {f"{place}/{name}" for name in LOGS}


@pytest.fixture
def backfill(cli, place, root):
    """Return a function that runs ``backfill``, two segments a job, four in flight."""

    def run(*arguments, output="out"):
        pace = () if "--batch-size" in arguments else ("--batch-size", "2", "--max-in-flight", "4")
        return cli("backfill", place, "--dataset", "av2", "--output", f"{root}/{output}", *pace, *arguments)

    return run


@pytest.fixture
def posts(monkeypatch):
    """What is posted from now on."""
    paths, post = [], Client.post
    monkeypatch.setattr(Client, "post", lambda self, path, body=None: (paths.append(path), post(self, path, body))[1])
    return paths


@pytest.fixture
def in_bucket(bucket):
    """The same logs in a bucket, which the service may read and write."""
    storage = open_storage(f"{bucket}/drives")
    for name in LOGS:
        storage.publish(f"{name}/sensors/lidar/1.feather", b"")
    return bucket


@pytest.fixture
def settings(settings, request):
    """A service that may use the bucket, in tests that have one."""
    if "bucket" not in request.fixturenames:
        return settings
    return settings.model_copy(update={"data_roots": (*settings.data_roots, request.getfixturevalue("bucket"))})
