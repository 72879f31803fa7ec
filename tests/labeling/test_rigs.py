"""The line on any rig: the same road users are found whatever the vehicle looks with, with one set of parameters."""

import numpy as np
import pytest

from labeling.geometry.boxes import iou_3d
from labeling.line import label_tracks, make_clock, observe_sweeps
from labeling.readers.reader import SegmentReader
from labeling.synthetic.rigs import RIGS
from labeling.synthetic.scene import Scene, drive, wall
from labeling.synthetic.shapes import block, car, walker
from schemas.config import resolve_config

NUM_SWEEPS = 10
CONFIG = resolve_config("fast", {"static.vote_gaps_s": (0.2, 0.4, 0.6)})
MOVERS = (drive(car(), (14, 3.5), 0.0, 6.0), drive(car(), (34, -3), np.pi, 9.0), drive(walker(), (10, -6), 1.2, 1.5))
PARKED = tuple(drive(car(), (x, -8.5)) for x in (4.0, 12.0, 20.0))
EGO = drive(block(), speed_mps=4.0).path
ROAD = Scene(structures=(wall((-40, 11), (80, 11), 6.0),), movers=(*MOVERS, *PARKED), ego=EGO)


class Recording(SegmentReader):
    """A reader that does not say how its lidars sample the world."""

    def __init__(self, reader):
        self.listing, self._reader = reader.listing, reader

    def read_sweep(self, index):
        return self._reader.read_sweep(index)


def label(reader):
    observations = list(observe_sweeps(reader, CONFIG))
    proposals = [observation.proposals for observation in observations]
    tracks = label_tracks(proposals, make_clock(observations), CONFIG, reader.segment_id)
    return [track for track in tracks if track.score.mean() >= 0.5]


def is_right(track, reader, mover):
    """Return for each row of a track whether it overlaps the mover's box at that time."""
    times_s = (track.timestamp_ns - reader.timestamps_ns[0]) * 1e-9
    truth = np.stack([reader.box_at(mover, time_s) for time_s in times_s])
    return np.diag(iou_3d(track.boxes, truth)) >= 0.4


@pytest.mark.parametrize("name", ["pair", "taxi", "rosette"])
def test_each_rig_finds_the_same_road_users(name):
    reader = ROAD.reader(NUM_SWEEPS, lidar=RIGS[name](32, 900, 0.02, 0.03))
    tracks = label(Recording(reader))
    num_seen = [(reader.object_index(k)[:, None] == range(len(MOVERS))).sum(axis=0) >= 20 for k in range(NUM_SWEEPS)]
    num_right = np.sum([[is_right(track, reader, mover).sum() for mover in range(len(MOVERS))] for track in tracks], 0)
    assert (num_right >= 0.7 * np.sum(num_seen, axis=0)).all()
    assert num_right.sum() >= 0.9 * sum(len(track.sweep_index) for track in tracks)
    assert num_right[:2].min() >= 7
