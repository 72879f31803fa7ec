"""ScenarioNet: sd_DATASET_1_SEGMENT.pkl, a scenario a segment, and the two files that list them.

Source: the scenario description of MetaDrive and ScenarioNet, github.com/metadriverse/metadrive.
"""

import pickle
from collections import Counter
from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from labeling.exporters.kinds import Kind, kinds_of
from labeling.exporters.output import ExportFolder
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import yaw_of
from labeling.trajectories.states import interpolate_track
from labeling.trajectories.trajectories import SegmentTracks
from labeling.trajectories.windows import Horizon, steps_ns
from schemas.arrays import BoolArray, Float64Array, Int64Array
from schemas.objects import BOX_LENGTH, BOX_YAW
from schemas.tables.labels import LabelRows

VERSION: Final = "1"
EGO: Final = "ego"
_PROTOCOL: Final = 4  # of pickle: the newest that Python 3.7 reads
_MOVED_M: Final = 1.0  # an object that went further counts as moving there
# Labels do not say how large the vehicle is that recorded them, and a replay draws it: a car of the middle class.
_EGO_SIZE_M: Final = (4.6, 1.9, 1.5)
_TYPES: Final = {
    Kind.PEDESTRIAN: "PEDESTRIAN",
    Kind.CYCLIST: "CYCLIST",
    Kind.CAR: "VEHICLE",
    Kind.TRUCK: "VEHICLE",
}

Scenario = dict[str, Any]  # of ScenarioNet's own make


def write(segments: Iterable[SegmentTracks], output: ExportFolder, horizon: Horizon) -> int:
    """Write a file a segment, then what lists them; see ``TrajectoryWriter``.

    A segment without a usable sweep has none. What is pickled are plain values and numpy's arrays.
    """
    listed: dict[str, Scenario] = {}
    for segment in segments:
        if segment.labels.sweeps:
            name = f"sd_{segment.labels.dataset}_{VERSION}_{segment.labels.segment_id}.pkl"
            scenario = make_scenario(segment, horizon.hz)
            output.put(name, pickle.dumps(scenario, _PROTOCOL))
            listed[name] = {**scenario["metadata"], "ts": scenario["metadata"]["ts"].tolist()}
    output.put("dataset_summary.pkl", pickle.dumps(listed, _PROTOCOL))
    output.put("dataset_mapping.pkl", pickle.dumps(dict.fromkeys(listed, ""), _PROTOCOL))
    return len(listed)


def make_scenario(segment: SegmentTracks, hz: float) -> Scenario:
    """Return one segment with at least a sweep: all tracks and the vehicle itself, at ``hz`` from first sweep to last.

    Axes are those of the world; the origin is where the vehicle is at first, so that float32 holds the places.
    """
    labels = segment.labels
    clock_ns = _clock_ns(segment.start_ns, labels.sweeps[-1].timestamp_ns, hz)
    origin_m = labels.sweeps[0].world_from_ego[:3, 3]
    ego = _track(_ego_rows(segment), "VEHICLE", clock_ns, origin_m, np.inf)
    tracks = {EGO: ego}
    for rows in segment.tracks:
        (kind,) = kinds_of(rows.boxes[:1])
        track = _track(rows, _TYPES[kind], clock_ns, origin_m, segment.max_gap_s)
        if track["state"]["valid"].any():
            tracks[track["metadata"]["object_id"]] = track
    summaries = {object_id: _summary(track) for object_id, track in tracks.items()}
    return {
        "id": labels.segment_id,
        "version": VERSION,
        "length": len(clock_ns),
        "metadata": {
            "ts": seconds_between(clock_ns, segment.start_ns).astype(np.float32),
            "metadrive_processed": False,
            "coordinate": "metadrive",
            "dataset": labels.dataset,
            "scenario_id": labels.segment_id,
            "sdc_id": EGO,
            "start_timestamp_ns": segment.start_ns,
            "world_origin_m": origin_m.tolist(),
            "object_summary": summaries,
            "number_summary": _numbers(summaries),
        },
        "tracks": tracks,
        "dynamic_map_states": {},
        "map_features": {},
    }


def _clock_ns(start_ns: int, last_ns: int, hz: float) -> Int64Array:
    num_steps = int(seconds_between(last_ns, start_ns) * hz + 1e-6) + 1
    return start_ns + steps_ns(np.arange(num_steps), hz)


def _ego_rows(segment: SegmentTracks) -> LabelRows:
    """Return the way of the vehicle itself as if it were a track."""
    sweeps = segment.labels.sweeps
    size = len(sweeps)
    poses = np.stack([sweep.world_from_ego for sweep in sweeps])
    stamps_ns = np.array([sweep.timestamp_ns for sweep in sweeps], dtype=np.int64)
    boxes = np.column_stack(
        [poses[:, :3, 3], np.tile(_EGO_SIZE_M, (size, 1)), [yaw_of(world_from_ego) for world_from_ego in poses]]
    )
    seconds = seconds_between(stamps_ns, segment.start_ns)
    velocity_mps = np.gradient(poses[:, :3, 3], seconds, axis=0) if size > 1 else np.zeros((1, 3))
    return LabelRows(
        sweep_index=np.array([sweep.sweep_index for sweep in sweeps], dtype=np.int64),
        timestamp_ns=stamps_ns,
        track_id=np.full(size, EGO),
        boxes=boxes,
        velocity_mps=velocity_mps,
        score=np.ones(size),
        num_points=np.zeros(size, dtype=np.int64),
        is_observed=np.ones(size, dtype=bool),
        boxes_visible=boxes,
        registration_error_m=np.full(size, np.nan),
    )


def _track(rows: LabelRows, kind: str, clock_ns: Int64Array, origin_m: Float64Array, max_gap_s: float) -> Scenario:
    states = interpolate_track(rows, clock_ns, max_gap_s)
    is_valid = states.is_valid
    sizes = np.where(is_valid[:, None], rows.boxes[0, BOX_LENGTH:BOX_YAW], 0.0).astype(np.float32)
    object_id = str(rows.track_id[0])
    return {
        "type": kind,
        "state": {
            "position": np.where(is_valid[:, None], states.center_m - origin_m, 0.0).astype(np.float32),
            "heading": states.yaw_rad.astype(np.float32),
            "velocity": states.velocity_mps[:, :2].astype(np.float32),
            "length": sizes[:, 0].copy(),
            "width": sizes[:, 1].copy(),
            "height": sizes[:, 2].copy(),
            "valid": is_valid,
            "score": states.score.astype(np.float32),
        },
        "metadata": {"type": kind, "track_length": len(clock_ns), "object_id": object_id, "dataset": "motionlabel"},
    }


def _summary(track: Scenario) -> Scenario:
    is_valid: BoolArray = track["state"]["valid"]
    way = track["state"]["position"][is_valid, :2].astype(np.float64)
    after_start = is_valid[is_valid.argmax() :]
    return {
        "type": track["type"],
        "object_id": track["metadata"]["object_id"],
        "track_length": len(is_valid),
        "moving_distance": float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()),
        "valid_length": int(is_valid.sum()),
        "continuous_valid_length": len(after_start) if after_start.all() else int(after_start.argmin()),
    }


def _numbers(summaries: dict[str, Scenario]) -> Scenario:
    of_type = Counter(summary["type"] for summary in summaries.values())
    moving = Counter(summary["type"] for summary in summaries.values() if summary["moving_distance"] > _MOVED_M)
    return {
        "num_objects": of_type.total(),
        "object_types": sorted(of_type),  # a list: the order of a set differs from run to run
        "num_objects_each_type": dict(sorted(of_type.items())),
        "num_moving_objects": moving.total(),
        "num_moving_objects_each_type": dict(sorted(moving.items())),
        "num_traffic_lights": 0,
        "num_traffic_light_types": [],
        "num_traffic_light_each_step": {},
        "num_map_features": 0,
        "map_height_diff": 0.0,
    }
