import pytest

from schemas import errors
from schemas.api.jobs import JobState
from service.dashboard import words


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0, "under a second"),
        (1, "1 s"),
        (59.9, "59 s"),
        (60, "1 min"),
        (3599, "59 min"),
        (3600, "1 h"),
        (3660, "1 h 1 min"),
        (86_399, "23 h 59 min"),
        (86_400, "1 d"),
        (90_000, "1 d 1 h"),
        (86_400 * 1234, "1,234 d"),
    ],
)
def test_durations(seconds, said):
    assert words.duration(seconds) == said


def test_numbers():
    assert [words.count(number, "job") for number in (0, 1, 3000)] == ["0 jobs", "1 job", "3,000 jobs"]
    assert [words.amount(number) for number in (0.123, 1.44, 9.99, 12.6, 12345)] == [
        "0.12",
        "1.4",
        "10",
        "13",
        "12,345",
    ]


def test_every_state_of_a_job_has_its_meaning():
    assert len({words.meaning(state) for state in JobState}) == len(JobState)


def test_whatever_ends_a_segment_has_advice_of_its_own():
    """Errors of ours that a segment or a job can end with, and what the job store and the dispatcher call theirs."""
    of_calls = {errors.JobNotFound, errors.JobConflict, errors.QueueFull, errors.StaleClaim}
    ours = [error for error in errors.LabelingError.__subclasses__() if error.__module__ == errors.__name__]
    names = {error.__name__ for error in ours if error not in of_calls}
    named = names | {"ClaimantLost", "DeadlineExceeded"}
    other = words.advise("OSError")
    assert len({words.advise(name).meaning for name in named}) == len(named)
    assert other not in [words.advise(name) for name in named]
    assert all(advice.meaning and advice.action for advice in map(words.advise, [*named, "OSError"]))
