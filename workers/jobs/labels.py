"""What a job has labelled so far, as the job store knows it: no label folder is read or needs to be reachable."""

from dataclasses import dataclass

from sqlalchemy import select

from schemas.api.jobs import JobState, SegmentState
from schemas.api.labels import JobLabels
from schemas.config import hash_values
from schemas.errors import JobNotFound
from schemas.manifest import RECOMMENDED_MIN_SCORE, SegmentEntry, Shard
from workers.jobs.database import Database
from workers.jobs.rows import count_segments, find_job
from workers.jobs.tables import jobs, segments

_LABELLED = (SegmentState.SUCCEEDED, SegmentState.PARTIAL)


def read_labels(database: Database, job_id: str, *, owner: str | None = None) -> JobLabels:
    """Return the manifest's entries of all segments that have labels, sorted by URI.

    Raises:
        JobNotFound: There is no such job, or none of this owner where one is named.

    """
    labelled = (
        select(segments.c.entry)
        .where(segments.c.job_id == job_id, segments.c.state.in_(_LABELLED))
        .order_by(segments.c.position)
    )
    with database.read() as connection:
        job = find_job(connection, job_id, owner=owner)
        config = connection.execute(select(jobs.c.config).where(jobs.c.id == job_id)).scalar_one()
        counts = count_segments(connection, [job_id])[job_id]
        entries = connection.scalars(labelled).all()
    return JobLabels(
        job_id=job.id,
        state=JobState(job.state),
        is_complete=counts[SegmentState.SUCCEEDED] == job.num_segments,
        dataset=job.dataset,
        output_uri=job.output_uri,
        config=config,
        config_hash=hash_values(config),
        recommended_min_score=RECOMMENDED_MIN_SCORE,
        num_segments=job.num_segments,
        segments=tuple(SegmentEntry.model_validate(entry) for entry in entries),
    )


@dataclass(frozen=True, slots=True)
class SegmentLabels:
    """Where the labels of one segment are."""

    uri: str
    state: SegmentState
    output_uri: str  # of the label folder
    shard: Shard | None  # of the table labels; None: the segment has none


def find_segment_labels(database: Database, job_id: str, position: int, *, owner: str | None = None) -> SegmentLabels:
    """Return where the labels of a job's segment are.

    Raises:
        JobNotFound: As ``read_labels``, or the job has no segment at this position.

    """
    columns = [segments.c[name] for name in ("uri", "state", "entry")]
    with database.read() as connection:
        job = find_job(connection, job_id, owner=owner)
        of_job = select(*columns).where(segments.c.job_id == job_id, segments.c.position == position)
        row = connection.execute(of_job).one_or_none()
    if row is None:
        raise JobNotFound(f"job {job_id} has no segment {position}: its last is {job.num_segments - 1}")
    entry = SegmentEntry.model_validate(row.entry) if row.state in _LABELLED else None
    shard = next((shard for shard in entry.shards if shard.table == "labels"), None) if entry else None
    return SegmentLabels(row.uri, SegmentState(row.state), job.output_uri, shard)
