"""Truth fed back as labels must be perfect on real logs too, with their tilted poses and rolling shutter."""

from pathlib import Path

import numpy as np
import pytest

from labeling.evaluation.report import evaluate_segments
from labeling.evaluation.truth import read_truth, sweep_point_truth
from labeling.geometry.transforms import rotate_vectors
from labeling.readers.reader import open_segment
from schemas.tables.points import PointRows, to_table

DATA = Path(__file__).resolve().parents[3] / "../shared/data"
SEGMENTS = {
    "simulated street": ("av2", "sim_av2/val/3bffdcff-s40-12", None),
    "camera view": ("kitti_raw", "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync", 40.0),
    "pair with flow labels": ("av2", "av2/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede", None),
}

pytestmark = pytest.mark.data


@pytest.fixture(params=list(SEGMENTS))
def segment(request):
    dataset, path, azimuth_deg = SEGMENTS[request.param]
    if not (DATA / path).is_dir():
        pytest.skip(f"{DATA / path} is not here: real logs stay outside the repository")
    return open_segment(dataset, str(DATA / path)), azimuth_deg


def true_labels(kit, reader, truth):
    log = kit.recorded(reader, truth.world_from_ego)
    rows = []
    for index in range(log.num_sweeps):
        here = truth.rows_of(index)
        for row in np.arange(len(truth.object_index))[here][truth.is_moving[here]]:
            name, speed = truth.object_ids[truth.object_index[row]], float(truth.speed_mps[row])
            rows.append(kit.label_row(log, index, name, truth.boxes_ego[row], 1.0, speed))
    return log, rows


def true_points(reader, truth):
    found = []
    for index in range(len(reader.timestamps_ns)):
        sweep = reader.read_sweep(index)
        point_truth = sweep_point_truth(truth, sweep, reader.read_point_truth(index), None)
        moving = np.flatnonzero(point_truth.is_moving)
        flow = np.full((len(moving), 3), np.nan)
        if point_truth.flow_ego_m is not None:
            flow = rotate_vectors(sweep.world_from_ego, point_truth.flow_ego_m[moving])
        found.append((np.full(len(moving), index), moving.astype(np.int32), flow.astype(np.float32)))
    sweep_index, point_index, flow_world_m = map(np.concatenate, zip(*found, strict=True))
    of_none = np.full(len(sweep_index), -1)
    rows = PointRows(
        sweep_index=sweep_index,
        timestamp_ns=reader.timestamps_ns[sweep_index],
        point_index=point_index,
        flow_world_m=flow_world_m,
        cluster_id=of_none.astype(np.int32),
        is_in_cluster=of_none >= 0,
        track_ids=(),
        track=of_none,
    )
    return to_table(reader.dataset, reader.segment_id, rows)


def test_truth_fed_back_is_perfect(kit, segment):
    reader, azimuth_deg = segment
    truth = read_truth(reader)
    log, rows = true_labels(kit, reader, truth)
    folder = kit.folder(log, rows)
    folder.tables["points", reader.segment_id] = true_points(reader, truth)
    report = evaluate_segments(folder, [reader], azimuth_deg=azimuth_deg, min_score=None)
    figures = report.pooled
    for one in figures.boxes.detection:
        assert one.num_truths >= 10
        assert (one.ap, one.precision, one.recall) == (1, 1, 1)
        assert one.aph == pytest.approx(1, abs=1e-3)  # a tilted ego frame turns headings by a little
    assert figures.tracks.hota == pytest.approx(1)
    assert figures.flow.moving_epe_m == pytest.approx(0, abs=1e-5)
    assert figures.flow.mean_speed_iou > 0.99
    assert figures.zero_flow.moving_epe_m > 0.4
    assert figures.static.moving_lost == 0
    assert figures.static.scene_recall == 1
