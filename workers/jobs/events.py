"""What happens to a job and its segments, one numbered event after another.

``rows`` records them. What a submit, a cancel or a retry does to many segments at once is one event, the job's.
"""

from typing import Final

from sqlalchemy import select

from schemas.api.jobs import JobEvent, JobState
from workers.jobs.bodies import describe_event
from workers.jobs.database import Database
from workers.jobs.rows import find_job
from workers.jobs.tables import events

PAGE_EVENTS: Final = 500


def read_events(
    database: Database, job_id: str, after: int, *, owner: str | None = None
) -> tuple[list[JobEvent], bool]:
    """Return the next events of a job that come after number ``after``, and whether the last of all is among them.

    Raises:
        JobNotFound: There is no such job, or none of this owner where one is named.

    """
    later = select(events).where(events.c.job_id == job_id, events.c.sequence > after).order_by(events.c.sequence)
    with database.read() as connection:
        job = find_job(connection, job_id, owner=owner)  # first: whatever has ended it by now is read next
        rows = connection.execute(later.limit(PAGE_EVENTS)).all()
    is_last = JobState(job.state).is_ended and len(rows) < PAGE_EVENTS
    return [describe_event(row) for row in rows], is_last
