"""Recordings of which only the annotations matter."""

from types import SimpleNamespace

import numpy as np
import pytest

from labeling.readers.reader import segment_id_of
from schemas.frames import Annotations

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def recorded(monkeypatch):
    """Return a builder of a recording: for each sweep (id, category, box in the ego frame) of its boxes, or None.

    The one that was built last is what is opened by its name.
    """
    known = {}
    monkeypatch.setattr("labeling.open_set.merging.open_segment", lambda _, uri: known[uri])

    def build(sweeps, *, uri="/data/log", dataset="av2"):
        def read_annotations(index):
            if sweeps[index] is None:
                return None
            ids, categories, boxes = zip(*sweeps[index], strict=True) if sweeps[index] else ((), (), ())
            return Annotations(ids, categories, np.array(boxes, dtype=np.float64).reshape(-1, 7))

        known[uri] = SimpleNamespace(
            dataset=dataset,
            uri=uri,
            segment_id=segment_id_of(dataset, uri),
            timestamps_ns=START_NS + np.arange(len(sweeps)) * 100_000_000,
            read_annotations=read_annotations,
        )
        return known[uri]

    return build


@pytest.fixture
def moved(car):
    """Return a function that gives the car's box, moved to its left."""
    return lambda left_m: [
        *(car.box_ego[:2] + left_m * np.array([-0.5, np.sqrt(3) / 2])),
        *car.box_ego[2:],
    ]
