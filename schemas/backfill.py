"""What a backfill tells of itself, while it runs and at its end."""

from pydantic import BaseModel, ConfigDict

from schemas.api.jobs import SegmentState


class BackfillSummary(BaseModel):
    """How far a backfill is. Its segments are those that this run asked for, or sees through for an earlier one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    dataset: str
    place: str
    output_uri: str
    is_complete: bool  # all that was to be asked for was, and has ended
    num_jobs: int
    segments: dict[SegmentState, int]  # how many are in each state; every state is listed
    num_refused: int  # segments that the service does not take
    num_unusable: int  # folders left out, for no place can have their name
    num_done_before: int  # segments that earlier runs saw labelled: they are not asked for again
    num_expected: int | None  # segments, with those still to be found; None: not known yet
    elapsed_s: float
    segments_per_hour: float | None  # that ended meanwhile; None: none did
    eta_s: float | None
    core_hours: float  # CPUs of the service, by the time and the share of it that these segments had
    expected_core_hours: float | None  # with all that are still to come

    @property
    def num_segments(self) -> int:
        """How many segments were asked for."""
        return sum(self.segments.values())

    @property
    def num_ended(self) -> int:
        """How many of them have ended, well or not."""
        return sum(count for state, count in self.segments.items() if state.is_ended)
