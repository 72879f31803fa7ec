"""Golden labels: what three small segments give, rounded, so that no change of labels goes unnoticed.

`make golden` writes them anew. It refuses while labels have moved and LABEL_VERSION has not: docs/decisions/0002.
"""

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from labeling.folders.folder import LabelFolder
from labeling.folders.identity import LABEL_VERSION
from labeling.in_process import label_in_process
from labeling.run import label_segments
from schemas.config import resolve_config
from schemas.tables import labels, points, sweeps

HERE = Path(__file__).parent
STREET = "synthetic:street?beams=16&azimuth_steps=450"

# Two labellings agree when no number differs by more than this. With the instructions of a CPU of 2008, not of one of
# 2023 (OPENBLAS_CORETYPE=Nehalem ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2 ONEDNN_MAX_CPU_ISA=SSE41)
# the largest difference was 4e-6 m and no count differed; the nets have few iterations, since many would spread it.
TOLERANCE = {"m": 1e-3, "rad": 1e-3, "mps": 1e-2, "score": 1e-3, "points": 2}
DECIMALS = 4

LABEL_COLUMNS = (
    ("sweep", None),
    ("track", None),
    *((name, "m") for name in ("x", "y", "z", "length", "width", "height")),
    ("yaw", "rad"),
    *((f"velocity_{axis}", "mps") for axis in "xyz"),
    ("score", "score"),
    ("num_points", "points"),
    ("is_observed", None),
    *((f"visible_{name}", "m") for name in ("x", "y", "z", "length", "width", "height")),
    ("visible_yaw", "rad"),
    ("registration_error", "m"),
)
SWEEP_COLUMNS = (
    ("sweep", None),
    *((name, "points") for name in ("num_points", "num_ground", "num_static")),
    ("num_clusters", "points"),
    ("num_failed_fits", None),
    ("reason", None),
)
POINT_COLUMNS = (  # one row a sweep and track: the points themselves would be many
    ("sweep", None),
    ("track", None),
    ("num_points", "points"),
    ("num_without_cluster", "points"),
    *((f"flow_{axis}", "m") for axis in "xyz"),  # mean
)
COLUMNS = {"labels": LABEL_COLUMNS, "sweeps": SWEEP_COLUMNS, "points": POINT_COLUMNS}
Rows = list[list[Any]]


@dataclass(frozen=True)
class Golden:
    """One segment and how it is labelled: small, cheap, and unlike the others."""

    name: str
    uri: str
    profile: str
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        return HERE / f"{self.name}.json"

    @property
    def question(self) -> dict[str, Any]:
        return {"uri": self.uri, "profile": self.profile, "overrides": self.overrides}


GOLDEN = (
    Golden("fast", f"{STREET}&sweeps=8&seed=5", "fast"),
    Golden(
        "default-with-points", f"{STREET}&sweeps=6&seed=2", "default", {"flow.iterations": 10, "write_points": True}
    ),
    Golden("paper", f"{STREET}&sweeps=6&seed=3", "paper", {"flow.iterations": 5, "flow.hidden_units": 16}),
)


def label(golden: Golden) -> dict[str, Rows]:
    """Label the segment and return its tables, rounded, with tracks numbered by their first row."""
    config = resolve_config(golden.profile, golden.overrides)
    with tempfile.TemporaryDirectory() as output:
        manifest = label_segments("synthetic", [golden.uri], output, config, label_in_process)
        folder = LabelFolder.open(output)
        (segment,) = manifest.segments
        return rows_of({name: folder.table(name, segment.segment_id) for name in COLUMNS})


def rows_of(tables: dict[str, pa.Table | None]) -> dict[str, Rows]:
    rows = labels.from_table(tables["labels"])
    rows = rows.take(np.lexsort((rows.boxes[:, 0], rows.sweep_index)))
    number = {track_id: k for k, track_id in enumerate(dict.fromkeys(rows.track_id.tolist()))}
    track = [number[track_id] for track_id in rows.track_id.tolist()]
    boxes = rows.boxes, rows.velocity_mps, rows.score, rows.num_points, rows.is_observed
    seen = rows.boxes_visible, rows.registration_error_m
    found: dict[str, Rows] = {
        "labels": _rounded(rows.sweep_index, track, *boxes, *seen),
        "sweeps": [
            [observed.sweep_index, *(getattr(observed, name) for name, _ in SWEEP_COLUMNS[1:])]
            for observed in sweeps.from_table(tables["sweeps"])
        ],
    }
    if tables["points"] is not None:
        found["points"] = list(_summed(points.from_table(tables["points"]), number))
    return found


def _rounded(*columns: Any) -> Rows:
    """Return the rows of these columns; of a (R, n) array each column is one. No number, as JSON has it, is None."""
    flat = [part for column in columns for part in (np.asarray(column).T if np.ndim(column) == 2 else [column])]
    return [[_round(value) for value in row] for row in zip(*(np.asarray(c).tolist() for c in flat), strict=True)]


def _round(value: Any) -> Any:
    if isinstance(value, float):
        return None if np.isnan(value) else round(value, DECIMALS) + 0.0  # no -0.0
    return value


def _summed(rows: points.PointRows, number: dict[str, int]) -> Iterator[list[Any]]:
    owner = np.array([*(number[track_id] for track_id in rows.track_ids), -1])[rows.track]
    for sweep, track in sorted(set(zip(rows.sweep_index.tolist(), owner.tolist(), strict=True))):
        here = (rows.sweep_index == sweep) & (owner == track)
        flow = rows.flow_world_m[here].astype(float).mean(axis=0)
        yield [sweep, track, int(here.sum()), int((~rows.is_in_cluster[here]).sum()), *map(_round, flow.tolist())]


def differences(name: str, old: Rows, new: Rows) -> list[str]:
    """Say where two labellings differ by more than the tolerances."""
    found = [] if len(old) == len(new) else [f"{name}: {len(old)} rows, now {len(new)}"]
    for number, (before, after) in enumerate(zip_longest(old, new, fillvalue=[])):
        for (column, unit), was, is_now in zip(COLUMNS[name], before, after, strict=False):
            if not _agree(was, is_now, unit):
                found.append(f"{name}, row {number} (sweep {before[0]}): {column} {was}, now {is_now}")
    return found


def _agree(was: Any, is_now: Any, unit: str | None) -> bool:
    if unit is None or was is None or is_now is None:
        return bool(was == is_now)
    difference = abs(was - is_now)
    if unit == "rad":
        difference = abs((difference + np.pi) % (2 * np.pi) - np.pi)
    return bool(difference <= TOLERANCE[unit] + 10**-DECIMALS)  # both were rounded


def read(golden: Golden) -> dict[str, Any] | None:
    """Return what is kept of a segment; None when nothing is, or it was labelled otherwise."""
    kept = json.loads(golden.path.read_text()) if golden.path.exists() else {}
    return kept if kept.get("question") == golden.question else None


def moved(golden: Golden, kept: dict[str, Any], found: dict[str, Rows]) -> list[str]:
    """Say where labels differ from those that are kept."""
    return [text for name in COLUMNS for text in differences(name, kept["tables"].get(name, []), found.get(name, []))]


def write(golden: Golden, found: dict[str, Rows]) -> None:
    """Keep the labels of a segment, a line a row."""
    tables = ",\n".join(
        f'"{name}": [\n' + ",\n".join(json.dumps(row) for row in rows) + "\n]" for name, rows in found.items()
    )
    head = f'"label_version": {LABEL_VERSION},\n"question": {json.dumps(golden.question)}'
    golden.path.write_text(f'{{\n{head},\n"tables": {{\n{tables}\n}}\n}}\n')


def remake(goldens: Sequence[Golden] = GOLDEN) -> int:
    """Write what has changed anew, unless labels moved under one version; return an exit code."""
    for golden in goldens:
        kept, found = read(golden), label(golden)
        texts = moved(golden, kept, found) if kept else []
        if kept and texts and kept["label_version"] == LABEL_VERSION:
            print(f"{golden.name}: {texts[0]} ({len(texts)} differences)", file=sys.stderr)
            print(
                f"labels have moved, but LABEL_VERSION is still {LABEL_VERSION}: "
                "raise it in labeling/folders/identity.py, then `make golden` again",
                file=sys.stderr,
            )
            return 1
        if kept is None or texts or kept["label_version"] != LABEL_VERSION:
            write(golden, found)
            print(f"{golden.path.name}: written for label version {LABEL_VERSION}")
    return 0


if __name__ == "__main__":
    sys.exit(remake())
