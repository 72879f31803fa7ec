"""Tracks whose way is known."""

import numpy as np
import pytest

from schemas.objects import LabeledTrack
from schemas.tables.labels import LabelRows

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def make_rows():
    """Return a builder of one track's rows from times, places, headings, velocities."""

    def build(times_s, center_m, yaw_rad, velocity_mps, *, is_observed=None, score=0.9, track_id="car"):
        times_s = np.asarray(times_s, dtype=np.float64)
        size = len(times_s)
        boxes = np.column_stack([center_m, np.tile([4.5, 1.8, 1.6], (size, 1)), yaw_rad]).astype(np.float64)
        return LabelRows(
            sweep_index=np.rint(times_s * 10).astype(np.int64),
            timestamp_ns=START_NS + np.rint(times_s * 1e9).astype(np.int64),
            track_id=np.full(size, track_id),
            boxes=boxes,
            velocity_mps=np.asarray(velocity_mps, dtype=np.float64),
            score=np.broadcast_to(np.asarray(score, dtype=np.float64), size).copy(),
            num_points=np.full(size, 10),
            is_observed=np.ones(size, dtype=bool) if is_observed is None else np.asarray(is_observed),
            boxes_visible=boxes,
            registration_error_m=np.zeros(size),
        )

    return build


@pytest.fixture
def circling(make_rows):
    """Return a builder of a car on a circle: 8 m/s, radius 20 m, anticlockwise, past the seam of yaw many times."""

    def build(times_s, *, radius_m=20.0, speed_mps=8.0, **options):
        angle = np.asarray(times_s) * speed_mps / radius_m
        yaw = np.pi - np.mod(np.pi - (angle + np.pi / 2), 2 * np.pi)
        place = [1000 + radius_m * np.cos(angle), -2000 + radius_m * np.sin(angle), np.full(len(angle), 5.0)]
        velocity = speed_mps * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        return make_rows(times_s, np.column_stack(place), yaw, velocity, **options)

    return build


@pytest.fixture
def driving(make_rows):
    """Return a builder of a car that drives straight ahead at 10 m/s, heading for +x unless it is told otherwise."""

    def build(times_s, *, yaw_rad=0.0, **options):
        size, ahead = len(times_s), np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
        place = 10 * np.asarray(times_s)[:, None] * ahead
        return make_rows(times_s, place, np.full(size, yaw_rad), np.tile(10 * ahead, (size, 1)), **options)

    return build


@pytest.fixture
def make_folder(make_labels, make_sweep):
    """Return a function that writes tracks, given as rows, into a label folder of so many sweeps, 0.1 s apart."""

    def write(tracks, num_sweeps=31, **options):
        labelled = [
            LabeledTrack(
                track_id=str(rows.track_id[0]),
                point_rows=(np.empty(0, dtype=np.int32),) * len(rows),
                **{name: getattr(rows, name) for name in rows.__slots__ if name != "track_id"},
            )
            for rows in tracks
        ]
        return make_labels(labelled, **{"sweeps": [make_sweep(index) for index in range(num_sweeps)], **options})

    return write
