"""The reservation: whose labels of a segment a label folder holds, or is about to."""

from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict

from schemas.tables import SCHEMA_VERSION

Reserved = Literal["labels", "points"]  # tables that share an identity share a reservation: labels' is sweeps' too
RESERVATIONS: Final = "reservations"  # the folder in the label folder


class Reservation(BaseModel):
    """OUT/reservations/<segment_id>-<table>.json. Beside the identity stands what it follows from."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: int = SCHEMA_VERSION
    segment_id: str
    table: Reserved
    identity: str
    label_version: int | None = None  # None, and no more is known: of shards from before there were reservations
    dataset: str = ""
    content: str = ""  # digest of what was read of the segment
    config: dict[str, Any] = {}  # the values that decide the table, as JSON

    @property
    def path(self) -> str:
        """Where it stands in the label folder."""
        return reservation_path(self.segment_id, self.table)

    def difference(self, ours: "Reservation") -> str:
        """Say how the labels under this reservation were made, if not as ``ours``."""
        if self.label_version is None:
            return "by an older motionlabel"
        if self.label_version != ours.label_version:
            return f"with other code (label version {self.label_version}, here {ours.label_version})"
        if self.dataset != ours.dataset:
            return f"as dataset {self.dataset}, here {ours.dataset}"
        if self.config != ours.config:
            return f"with other settings ({_first_difference(self.config, ours.config)})"
        if self.content != ours.content:
            return "from other sweeps (the recording has changed since)"
        return "by an older motionlabel"


def reservation_path(segment_id: str, table: Reserved) -> str:
    """Return where a reservation stands in the label folder."""
    return f"{RESERVATIONS}/{segment_id}-{table}.json"


def _first_difference(theirs: dict[str, Any], ours: dict[str, Any], path: str = "") -> str:
    for key in sorted({*theirs, *ours}):
        there, here = theirs.get(key), ours.get(key)
        if isinstance(there, dict) and isinstance(here, dict):
            if there != here:
                return _first_difference(there, here, f"{path}{key}.")
        elif there != here:
            return f"{path}{key}={there}, here {here}"
    return ""
