"""What a segment was found to hold, once, by whoever opened it first."""

import hashlib
import json
from dataclasses import dataclass

import numpy as np

from schemas.arrays import Int64Array, read_only, require
from schemas.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class ExternalFlow:
    """The flow files of one segment as they were listed: what is in them decides labels."""

    folder: str  # a canonical place
    digests: tuple[tuple[str, str], ...]  # name of each file in it, and the SHA-256 of its content


@dataclass(frozen=True, slots=True, eq=False)
class SegmentListing:
    """One segment as it was listed. Whoever gets this opens the segment again without looking what is there.

    So all see the same sweeps while files come and go: one that is gone is an unreadable sweep, one that came later is
    not seen.
    """

    dataset: str
    uri: str  # the canonical name of the segment
    segment_id: str
    timestamps_ns: Int64Array  # (T,) strictly ascending; T >= 1
    names: tuple[str, ...] = ()  # of the files that sweeps are read from, below ``uri``; what each is, its reader knows
    common: tuple[tuple[str, str], ...] = ()  # files that every sweep needs, as poses: place, SHA-256 or "" for none
    flow: ExternalFlow | None = None  # None: it is estimated

    def __post_init__(self) -> None:
        """Check the time stamps and make them read-only."""
        require("timestamps_ns", self.timestamps_ns, (None,), np.int64)
        if not len(self.timestamps_ns) or (np.diff(self.timestamps_ns) <= 0).any():
            raise InvalidInput(f"{self.uri}: expected one sweep or more, with time stamps that ascend")
        object.__setattr__(self, "timestamps_ns", read_only(self.timestamps_ns))

    @property
    def digest(self) -> str:
        """16 hex digits of what was listed: other input, another.

        Time stamps, names, the content of what every sweep needs, and names and content of external flow. It says
        nothing of where all that lies, nor of what is in the sweeps, which are not read when they are listed.
        """
        common = [digest for _, digest in self.common]
        flow = self.flow.digests if self.flow else None
        content = json.dumps([self.timestamps_ns.tolist(), self.names, common, flow])
        return hashlib.sha256(content.encode()).hexdigest()[:16]
