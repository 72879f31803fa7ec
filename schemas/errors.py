"""The exception tree. Each message is one line: what, where, what was expected, the likely cause.

LabelingError
|- InvalidInput       a caller's mistake, or a segment that cannot be read at all
|- UnreadableSweep    one sweep is bad: it is rejected and counted, the rest is labelled
|- StageFailed        a stage could not finish on data that passed every check: our bug
|- StorageTrouble     the disk or the network refused: nothing is said about the data, and another time may do
|- ShardConflict      the output folder already holds other labels of the same segment
|- JobNotFound        no job has this id
|- JobConflict        the job's state, or an earlier request of the same name, does not allow it
|- QueueFull          its owner has as much waiting as one may have: another time it will do
|- StaleClaim         a segment was taken back and may be in other hands: its former holder stops
`- WorkerLost         the machinery failed, not the data: the same work may succeed another time

What a message quotes of its input is short, whatever the input is.
"""

import reprlib
from typing import Final

_MAX_LINE: Final = 1000  # characters; the lists of options are the longest lines of ours
_QUOTES: Final = reprlib.Repr()
_QUOTES.maxstring = _QUOTES.maxother = 100


class LabelingError(Exception):
    """Base of all errors that motionlabel raises on purpose."""


class InvalidInput(LabelingError):
    """A path, an option, an array or a segment is not what it has to be."""


class UnreadableSweep(LabelingError):
    """One sweep cannot be used; its neighbours can."""


class StageFailed(LabelingError):
    """A stage broke on checked data."""

    @classmethod
    def by(cls, cause: BaseException) -> "StageFailed":
        """Return what to say of an exception that nobody raised on purpose, in one line."""
        return cls(" ".join(f"{type(cause).__name__}: {cause}".split()))


class StorageTrouble(LabelingError):
    """The disk or the network refused; running it again goes on."""


class ShardConflict(LabelingError):
    """Other labels of the same segment stand where these should go."""


class JobNotFound(LabelingError):
    """No job has this id."""


class JobConflict(LabelingError):
    """What is asked of a job cannot be done in its state, or its name stands for another request."""


class QueueFull(LabelingError):
    """An owner's open segments, and those to come, are more than one owner may have."""


class StaleClaim(LabelingError):
    """Whoever reports on a segment does not hold it any more."""


class WorkerLost(LabelingError):
    """Workers died, or were lost with their machine, more often than is tried again."""


def quote(value: object) -> str:
    """Return a value as messages quote it: of a long or deep one, its ends."""
    try:
        return _QUOTES.repr(value)
    except ValueError:  # Python prints no number of more than 4,300 digits
        return "a number of thousands of digits"


def shorten(text: str) -> str:
    """Return a text as one line, the middle left out where it is too long for one."""
    line = " ".join(text.split())
    return line if len(line) <= _MAX_LINE else f"{line[: _MAX_LINE // 2]} ... {line[-_MAX_LINE // 2 :]}"
