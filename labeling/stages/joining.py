"""Joining: tracks that are pieces of one object -> one track.

The static filter, windows and occlusion break objects into pieces, in space and in time. Two solid bodies cannot share
a place: tracks whose amodal boxes do, sweep after sweep, moving alike, are one object. A track that ends where, and as
fast as, another begins is the same object behind an occlusion, or after a pause.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from labeling.geometry.boxes import paired_bev_intersection_m2, tight_box
from labeling.geometry.times import median_period_s, seconds_between, sweeps_within
from labeling.stages.parts import boxes_when, parts_of_vehicles
from labeling.stages.tracking import make_track_id
from schemas.arrays import Float64Array
from schemas.config import JoiningParams
from schemas.objects import BOX_LENGTH, BOX_WIDTH, LabeledTrack, Proposal, Track

SAME_PLACE_SHARE = 0.8  # of the smaller box: where two tracks share so much, their speeds need not agree
MIN_COMMON_SWEEPS = 2  # at any rate
MIN_SHRED_SHARE = 0.8  # of a shred's sweeps, in which the whole is seen too
PAUSE_SPEED_MPS = 2.0  # slower at both ends of a silence: the object may have stood


def join_tracks(
    tracks: Sequence[Track],
    labeled: Sequence[LabeledTrack],  # what refinement made of each track, same order
    params: JoiningParams,
    segment_id: str,
) -> list[Track]:
    """Return the tracks with pieces of one object joined; what is not joined is returned as it came.

    A shred of an object, inside its box wherever it is seen but at another speed, is dropped: its flow is wrong, and
    the object would be bent by it.

    Source: ours; the paper tracks pieces as they are.
    """
    kept = _without_shreds(labeled, params)
    tracks, labeled = [tracks[k] for k in kept], [labeled[k] for k in kept]
    pairs = [
        (i, j)
        for i in range(len(tracks))
        for j in range(i + 1, len(tracks))
        if _is_same_object(labeled[i], labeled[j], params)
    ]
    pairs += parts_of_vehicles(labeled)
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(len(tracks), len(tracks)))
    _, group_of_track = connected_components(graph, directed=False)
    joined = []
    for group in dict.fromkeys(group_of_track.tolist()):
        members = [tracks[k] for k in np.flatnonzero(group_of_track == group).tolist()]
        joined.append(members[0] if len(members) == 1 else _join(members, segment_id))
    return joined


def _without_shreds(labeled: Sequence[LabeledTrack], params: JoiningParams) -> list[int]:
    """Return the positions of the tracks that are no shreds of another."""
    num_points = [int(track.num_points.sum()) for track in labeled]
    by_size = sorted(range(len(labeled)), key=lambda k: (-num_points[k], k))
    kept: list[int] = []
    for k in by_size:
        if not any(_is_shred(labeled[k], labeled[larger], params) for larger in kept):
            kept.append(k)
    return sorted(kept)


def _is_shred(small: LabeledTrack, large: LabeledTrack, params: JoiningParams) -> bool:
    """Say whether ``small`` lies in the box of ``large`` in nearly all of its sweeps, but moves otherwise."""
    _, in_small, in_large = np.intersect1d(small.sweep_index, large.sweep_index, return_indices=True)
    if len(in_small) < max(_min_common_sweeps(large, params), MIN_SHRED_SHARE * len(small.sweep_index)):
        return False
    if is_alike(small.velocity_mps[in_small].mean(axis=0), large.velocity_mps[in_large].mean(axis=0), params):
        return False
    share = np.median(_shared(small.boxes[in_small], boxes_when(large, in_large, small, in_small)))
    return bool(share >= SAME_PLACE_SHARE)


def _is_same_object(a: LabeledTrack, b: LabeledTrack, params: JoiningParams) -> bool:
    first, second = (a, b) if a.timestamp_ns[0] <= b.timestamp_ns[0] else (b, a)
    gap_s = seconds_between(int(second.timestamp_ns[0]), int(first.timestamp_ns[-1]))
    if gap_s > params.max_pause_s:
        return False
    _, in_a, in_b = np.intersect1d(a.sweep_index, b.sweep_index, return_indices=True)
    if len(in_a):
        share = np.median(_shared(a.boxes[in_a], boxes_when(b, in_b, a, in_a)))
        if is_alike(a.velocity_mps[in_a].mean(axis=0), b.velocity_mps[in_b].mean(axis=0), params):
            return bool(share >= params.min_shared_area)
        return bool(share >= SAME_PLACE_SHARE and len(in_a) >= _min_common_sweeps(a, params))
    return gap_s > 0 and _goes_on(first, second, gap_s, params)


def _min_common_sweeps(track: LabeledTrack, params: JoiningParams) -> int:
    """Return in how many sweeps two tracks must be seen together for their places to count."""
    return max(MIN_COMMON_SWEEPS, sweeps_within(params.min_common_s, median_period_s(track.timestamp_ns)))


def _goes_on(first: LabeledTrack, second: LabeledTrack, gap_s: float, params: JoiningParams) -> bool:
    """Say whether ``second`` begins where ``first`` would be by then."""
    before, after = first.velocity_mps[-1], second.velocity_mps[0]
    met = first.boxes[-1:].copy()
    if gap_s <= params.max_silence_s:
        met[0, :3] += (before + after) / 2 * gap_s
        return bool(_shared(met, second.boxes[:1])[0] >= params.min_shared_area) and is_alike(before, after, params)
    has_paused = max(np.linalg.norm(before[:2]), np.linalg.norm(after[:2])) < PAUSE_SPEED_MPS
    return bool(has_paused and _shared(met, second.boxes[:1])[0] >= 0.5)


def _shared(boxes_a: Float64Array, boxes_b: Float64Array) -> Float64Array:
    """Return (n,) shared areas of paired boxes, as shares of the smaller one."""
    smaller = np.minimum(boxes_a[:, BOX_LENGTH] * boxes_a[:, BOX_WIDTH], boxes_b[:, BOX_LENGTH] * boxes_b[:, BOX_WIDTH])
    return paired_bev_intersection_m2(boxes_a, boxes_b) / smaller


def is_alike(velocity_a: Float64Array, velocity_b: Float64Array, params: JoiningParams) -> bool:
    """Tell whether two pieces move alike, (3,) world velocities."""
    difference = np.linalg.norm((velocity_a - velocity_b)[:2])
    speed = max(np.linalg.norm(velocity_a[:2]), np.linalg.norm(velocity_b[:2]))
    return bool(difference <= params.max_speed_difference_mps + params.max_speed_difference_share * speed)


def _join(members: Sequence[Track], segment_id: str) -> Track:
    first, *others = members
    return extend(first, [proposal for track in others for proposal in track.proposals], segment_id)


def extend(track: Track, pieces: Sequence[Proposal], segment_id: str) -> Track:
    """Return the track with more pieces of its object, united with those it has in a sweep."""
    of_sweep: dict[int, list[Proposal]] = {}
    for proposal in [*track.proposals, *pieces]:
        of_sweep.setdefault(proposal.sweep_index, []).append(proposal)
    proposals = tuple(_unite(of_sweep[index]) for index in sorted(of_sweep))
    return Track(make_track_id(segment_id, proposals[0]), proposals)


def _unite(pieces: Sequence[Proposal]) -> Proposal:
    """Return one proposal of all pieces of an object in one sweep, carried to their points' mean capture time.

    A vehicle at the seam of the lidar's turn is seen twice, a turn apart.
    """
    if len(pieces) == 1:
        return pieces[0]
    pieces = sorted(pieces, key=lambda piece: (-len(piece.points_world), int(piece.point_rows[0])))
    weights = np.array([len(piece.points_world) for piece in pieces], dtype=np.float64)
    velocity = np.average([piece.velocity_mps for piece in pieces], axis=0, weights=weights)
    delay_ns = np.array([piece.timestamp_ns - pieces[0].timestamp_ns for piece in pieces])
    mean_ns = round(float(np.average(delay_ns, weights=weights)))
    way_m = (mean_ns - delay_ns)[:, None] * 1e-9 * velocity
    points = np.concatenate([piece.points_world + way for piece, way in zip(pieces, way_m, strict=True)])
    return Proposal(
        sweep_index=pieces[0].sweep_index,
        timestamp_ns=pieces[0].timestamp_ns + mean_ns,
        box_visible=tight_box(points, float(np.arctan2(velocity[1], velocity[0]))),
        velocity_mps=velocity,
        points_world=points,
        point_rows=np.concatenate([piece.point_rows for piece in pieces]),
        ground_z_m=pieces[0].ground_z_m,
        sensor_origin_world=pieces[0].sensor_origin_world,
        num_vacated=sum(piece.num_vacated for piece in pieces),
        range_noise_m=pieces[0].range_noise_m,
    )
