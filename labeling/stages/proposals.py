"""Proposals: points that move alike and lie together -> tight boxes of what is seen of moving objects."""

import numpy as np
from sklearn.cluster import DBSCAN

from labeling.geometry.boxes import tight_box, transform_boxes
from labeling.geometry.transforms import rotate_vectors, transform_points
from labeling.geometry.voxels import group_by_voxel
from labeling.stages.walkers import part_walkers
from schemas.arrays import Float32Array, FloatArray, Int64Array, require
from schemas.config import ProposalParams
from schemas.objects import DynamicPoints, Proposal

HEADING_STEP_RAD = np.deg2rad(1.0)  # of the search for the smallest box
MERGE_SHARE = 0.1  # of eps: points closer than this are one weighted sample to DBSCAN, which bounds its memory


def propose_boxes(
    dynamic: DynamicPoints,
    velocity_ref_mps: Float32Array | None,  # (M, 3) flow over its time gap, ego axes; None: no flow
    params: ProposalParams,
) -> tuple[Proposal, ...]:
    """Cluster the moving points of a sweep by position and by velocity; box each intersection along its mean flow.

    Positions are those at one instant: points are carried there by their flow (step ``deskewing``).

    Without flow all points are clustered, by position alone, and the boxes are the smallest seen from above.

    Returns:
        Proposals in the world frame, largest first. Empty when nothing moves.

    Source: paper Algorithm 1. Without step ``flow_clustering`` it is the weaker clustering of the ablation, by position
    only; no flow is the "No flow" of the table of detection. Step ``walkers`` is ours: people side by side are one
    each.

    """
    has_flow = velocity_ref_mps is not None
    if velocity_ref_mps is None:
        velocity_ref_mps = np.zeros_like(dynamic.points_ego)
        rows = np.arange(len(velocity_ref_mps))
    else:
        require("velocity_ref_mps", velocity_ref_mps, (len(dynamic.points_ego), 3), np.float32)
        rows = np.flatnonzero(np.linalg.norm(velocity_ref_mps, axis=1) >= params.min_speed_mps)
    if len(rows) == 0:
        return ()
    positions = dynamic.points_ego
    if params.has("deskewing"):  # at one instant: what lies at the seam of a turn is seen in two places
        positions = positions - dynamic.capture_offset_s[:, None] * velocity_ref_mps
    by_position = _dbscan(positions[rows], params.position_eps_m, params.min_samples)
    by_flow = (
        _dbscan(velocity_ref_mps[rows], params.flow_eps_mps, params.min_samples)
        if params.has("flow_clustering")
        else np.zeros(len(rows), dtype=np.int64)
    )
    is_core = (by_position >= 0) & (by_flow >= 0)
    label = by_position * (by_flow.max(initial=0) + 1) + by_flow
    groups = [rows[is_core & (label == k)] for k in np.unique(label[is_core])]
    if params.has("walkers") and has_flow:
        groups = [person for group in groups for person in _walkers_of(dynamic, positions, group, velocity_ref_mps)]
    groups = sorted((g for g in groups if len(g) >= params.min_points), key=lambda g: (-len(g), int(g[0])))
    means = [velocity_ref_mps[g].mean(axis=0, dtype=np.float64) for g in groups]
    return tuple(
        make_proposal(dynamic, g, mean, is_deskewed=params.has("deskewing"))
        for g, mean in zip(groups, means, strict=True)
    )


def _walkers_of(
    dynamic: DynamicPoints, positions: Float32Array, rows: Int64Array, velocity_ref_mps: Float32Array
) -> list[Int64Array]:
    points, lidar = positions[rows], dynamic.beams.of(rows).main
    resolution_m = lidar.azimuth_resolution_rad * float(np.linalg.norm((points.mean(axis=0) - lidar.origin_m)[:2]))
    speed_mps = float(np.linalg.norm(velocity_ref_mps[rows].mean(axis=0)))
    return [rows[part] for part in part_walkers(points, resolution_m, speed_mps)]


def make_proposal(
    dynamic: DynamicPoints,
    rows: Int64Array,  # (P,) rows of ``dynamic`` that belong to the object, P >= 1
    velocity_ref_mps: FloatArray,  # (3,) ego axes
    *,
    is_deskewed: bool,
) -> Proposal:
    """Return the proposal of one object: tight box along its motion, world frame, at its points' mean capture time.

    Without motion the box is the smallest seen from above, length along its longer side: front and rear are unknown.

    A rolling shutter smears what moves: ``is_deskewed`` carries each point along the motion to the mean capture time.
    """
    world_from_ego = dynamic.world_from_ego
    capture_s = dynamic.capture_offset_s[rows].astype(np.float64)
    mean_offset_s = float(capture_s.mean())
    smear = (capture_s - mean_offset_s)[:, None] * velocity_ref_mps
    points = dynamic.points_ego[rows] - smear if is_deskewed else dynamic.points_ego[rows]
    is_moving = velocity_ref_mps.any()
    heading = float(np.arctan2(velocity_ref_mps[1], velocity_ref_mps[0])) if is_moving else _smallest_heading(points)
    box_ego = tight_box(points, heading)
    ground_z_ego = float(np.median(points[:, 2] - dynamic.height_m[rows]))
    ground_point = np.array([[box_ego[0], box_ego[1], ground_z_ego]])
    lidar = dynamic.beams.of(rows).main
    return Proposal(
        sweep_index=dynamic.sweep_index,
        timestamp_ns=dynamic.timestamp_ns + round(mean_offset_s * 1e9),
        box_visible=transform_boxes(world_from_ego, box_ego[None])[0],
        velocity_mps=rotate_vectors(world_from_ego, np.asarray(velocity_ref_mps)),
        points_world=transform_points(world_from_ego, points),
        point_rows=dynamic.clusters.point_rows[rows].astype(np.int32),
        ground_z_m=float(transform_points(world_from_ego, ground_point)[0, 2]),
        sensor_origin_world=transform_points(world_from_ego, np.array([lidar.origin_m]))[0],
        num_vacated=int(dynamic.is_vacated[rows].sum()),
        range_noise_m=lidar.noise_m,
    )


def _smallest_heading(points: FloatArray) -> float:
    """Return the yaw in [-pi/2, pi/2) along the longer side of the smallest rectangle around (N, 3) points."""
    yaw = np.arange(0, np.pi / 2, HEADING_STEP_RAD)
    along = np.stack([np.cos(yaw), np.sin(yaw)])
    across = np.stack([-np.sin(yaw), np.cos(yaw)])
    offset = points[:, :2].astype(np.float64) - points[0, :2]
    length, width = np.ptp(offset @ along, axis=0), np.ptp(offset @ across, axis=0)
    best = int(np.argmin(length * width))
    return float(yaw[best] if length[best] >= width[best] else yaw[best] - np.pi / 2)


def _dbscan(samples: FloatArray, eps: float, min_samples: int) -> Int64Array:
    """Return (N,) labels, -1 for noise. Nearly equal samples are merged and weigh as many as they are."""
    groups = group_by_voxel(samples, eps * MERGE_SHARE)
    merged = samples[groups.first_point].astype(np.float64)
    labels = DBSCAN(eps=eps, min_samples=min_samples).fit(merged, sample_weight=groups.num_points).labels_
    return np.asarray(labels, dtype=np.int64)[groups.voxel_of_point]
