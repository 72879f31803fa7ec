"""How the dashboard says durations, numbers, states and failures to people."""

from dataclasses import dataclass
from typing import Final

from schemas.api.jobs import JobState

_MINUTE_S: Final = 60
_HOUR_S: Final = 3600
_DAY_S: Final = 24 * _HOUR_S


@dataclass(frozen=True, slots=True)
class Advice:
    """What a failure means, and what to do about it."""

    meaning: str
    action: str


_RETRY: Final = "Retry the job: finished segments are kept."
_ADVICE: Final[dict[str, Advice]] = {  # by the name that a Failure gives
    "InvalidInput": Advice(
        "The segment cannot be read, or an option does not fit it.",
        "Mend the data that the message names and retry, or submit a new job with other options.",
    ),
    "UnreadableSweep": Advice("No sweep of the segment can be read.", "Copy the segment's files anew, then retry."),
    "StageFailed": Advice(
        "A stage broke on data that passed every check: a bug of motionlabel.",
        "Report it with the message and the segment. A retry helps only after an upgrade.",
    ),
    "StorageTrouble": Advice(
        "A disk or a bucket refused to read or write.",
        "Look at its free space, permissions and network, then retry: the job goes on where it stopped.",
    ),
    "ShardConflict": Advice(
        "The output folder holds other labels of the same segment.",
        "Submit a new job with another output folder, or with the options of the labels that are there.",
    ),
    "WorkerLost": Advice(
        "Its processes died several times, most often for want of memory.",
        "Look at the memory of the workers' machines, then retry.",
    ),
    "ClaimantLost": Advice(
        "Its dispatcher went silent several times: killed, or cut off from the job store.",
        "See that a dispatcher runs and stays up, then retry.",
    ),
    "DeadlineExceeded": Advice(
        "The job was not done by its deadline.",
        "Retry: the deadline starts again, and finished segments are kept.",
    ),
}
PARTIAL_LABELS: Final = Advice(
    "Some of its sweeps could not be read, or some fits failed.",
    "Its entry in the job's labels says how many. It has labels: a retry leaves it alone.",
)
_OTHER: Final = Advice("It failed for a reason that has no name here; the message says more.", _RETRY)

_MEANINGS: Final[dict[JobState, str]] = {
    JobState.QUEUED: "waits for a free worker",
    JobState.RUNNING: "is being labelled",
    JobState.CANCELLING: "is being stopped",
    JobState.SUCCEEDED: "every label is there",
    JobState.PARTIAL: "some labels are missing",
    JobState.FAILED: "no labels, through data or code",
    JobState.CANCELLED: "was stopped; what was labelled stays",
    JobState.TIMED_OUT: "was stopped by its deadline; what was labelled stays",
    JobState.CRASHED: "no labels, through lost machines",
}


def advise(error: str) -> Advice:
    """Return what a ``Failure.error`` means and what to do about it."""
    return _ADVICE.get(error, _OTHER)


def meaning(state: JobState) -> str:
    """Return what a job's state means."""
    return _MEANINGS[state]


def duration(seconds: float) -> str:
    """Return a duration in its two largest units, or in seconds, or minutes, alone."""
    if seconds < 1:
        return "under a second"
    if seconds < _MINUTE_S:
        return f"{int(seconds)} s"
    if seconds < _HOUR_S:
        return f"{int(seconds // _MINUTE_S)} min"
    if seconds < _DAY_S:
        return _two_units(seconds, ("h", _HOUR_S), ("min", _MINUTE_S))
    return _two_units(seconds, ("d", _DAY_S), ("h", _HOUR_S))


def _two_units(seconds: float, large: tuple[str, int], small: tuple[str, int]) -> str:
    whole, rest = int(seconds // large[1]), int(seconds % large[1] // small[1])
    return f"{whole:,} {large[0]}" + (f" {rest} {small[0]}" if rest else "")


def count(number: int, noun: str) -> str:
    """Return a number and its noun, as 1 job, 3,000 jobs."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def amount(number: float) -> str:
    """Return a positive number with two significant digits, or all before the point."""
    return f"{number:,.0f}" if number >= 10 else f"{number:.2g}"
