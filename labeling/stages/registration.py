"""Registration: the views of a track -> one cloud, and how each view lies on it."""

import numpy as np

from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, transform_points, wrap_angle, yaw_of, yaw_translation
from labeling.geometry.voxels import group_by_voxel, spread_points, spread_rows
from labeling.stages.icp import Alignment, align, alignment_errors
from schemas.arrays import Float32Array, Float64Array
from schemas.config import RegistrationParams
from schemas.objects import BOX_LENGTH, BOX_WIDTH, BOX_YAW, AlignedTrack, Track

MODEL_VOXEL_M = 0.05  # the growing target is thinned to this
DENSE_VIEW = 16384  # points: from here their density says more about the lidar than about the object
MIN_STIFF_LENGTH_M = 2.5  # of the longest view: a vehicle
MAX_TURN_RAD = 0.35  # of a vehicle from one view to the next, beyond what their headings say
MAX_JUMP_M = 2.0  # of a view from where flow led, unless it led farther than that
LONG_RATIO = 3.0  # of length to width (standard deviations): a flat side
MIN_SLIDE_LENGTH_M = 6.0  # of an object's longest view: a car's ends are never far, and flow is no better than them
SLIDE_M = 0.5  # by which a flat side is moved along itself
SLIDE_RISE_M = 0.06  # of its error, below which it slides


def register_track(track: Track, params: RegistrationParams) -> AlignedTrack:
    """Align the views of a track into one cloud: densest view first, then forward and backward in time.

    Each view starts from a grid of translations over the target box, turned by the difference of headings; ICP runs
    from the starts and the least error wins; the view then joins the target. At the end each view is aligned again,
    from where it lies, with all the others (step ``joint_rounds``): the first ones met a target that was small as yet,
    and what they were off by is in all that followed.

    Returns:
        ``model_from_world`` (T, 4, 4): how each view lies on the aggregate. The model frame is the world frame moved to
        the centroid of the densest view.

    Source: paper Algorithm 2 and appendix. We differ (off in profile ``paper``) in the joint rounds, in refining only
    the most promising starts, and in one more, the neighbour view's place advanced by the flow. What that one leads to
    stays unless another start ends with an error less by ``motion_margin_m``: a flat side slides along itself. Of an
    object longer than MIN_SLIDE_LENGTH_M, a side that fits anywhere lies along itself where the flow led. A vehicle's
    view turns no farther than MAX_TURN_RAD from there: one side fits on another, and all later views would follow.
    None lies farther from there than flow led, or MAX_JUMP_M: a side fits on itself after any slide.

    """
    views = [proposal.points_world for proposal in track.proposals]
    target_view = int(np.argmax([len(view) for view in views]))
    origin = views[target_view].mean(axis=0)
    headings = np.array([proposal.box_visible[BOX_YAW] for proposal in track.proposals])
    target_box = track.proposals[target_view].box_visible
    longest_m = longest_view_m(track)
    max_turn_rad = MAX_TURN_RAD if longest_m >= MIN_STIFF_LENGTH_M else np.pi
    may_slide = params.has("slide_test") and params.has("motion_start") and longest_m >= MIN_SLIDE_LENGTH_M

    model_from_world = np.tile(np.eye(4), (len(views), 1, 1))
    model_from_world[target_view, :3, 3] = -origin
    error_m = np.full(len(views), np.nan)
    model = _thin((views[target_view] - origin).astype(np.float32), params.max_target_points)
    clouds = {target_view: (views[target_view] - origin).astype(np.float32)}
    order = [*range(target_view + 1, len(views)), *range(target_view - 1, -1, -1)]
    for i in order:
        turn = float(wrap_angle(headings[target_view] - headings[i])) if params.has("rotation_start") else 0.0
        alignment = _align_view(views[i], model, _grid_starts(turn, target_box, params), params)
        if params.has("motion_start"):
            neighbor = i - 1 if i > target_view else i + 1
            start = _motion_start(track, i, neighbor, model_from_world[neighbor])
            moved = _align_view(views[i], model, start[None], params)
            if _turn_rad(moved, start) > max_turn_rad:
                moved = _as_it_lies(views[i], model, start, params)
            held = _held_by_flow(views[i], model, moved, start, params) if may_slide else None
            if held is not None:
                alignment = held
            elif (
                moved.error_m <= alignment.error_m + params.motion_margin_m
                or _turn_rad(alignment, start) > max_turn_rad
                or _shift_m(alignment, start) > max(MAX_JUMP_M, np.hypot(*_way(track, i, neighbor)[:2]))
            ):
                alignment = moved
        model_from_world[i], error_m[i] = alignment.target_from_source @ _to_center(views[i]), alignment.error_m
        clouds[i] = transform_points(model_from_world[i], views[i]).astype(np.float32)
        model = _thin(np.concatenate([model, clouds[i]]), params.max_target_points)
    for _ in range(params.joint_rounds if len(views) > 2 and params.has("joint_rounds") else 0):
        for i in order:
            others = _thin(np.concatenate([clouds[k] for k in range(len(views)) if k != i]), params.max_target_points)
            start = model_from_world[i] @ invert(_to_center(views[i]))
            alignment = _align_view(views[i], others, start[None], params)
            held = _held_by_flow(views[i], others, alignment, start, params) if may_slide else None
            alignment = alignment if held is None else held
            model_from_world[i], error_m[i] = alignment.target_from_source @ _to_center(views[i]), alignment.error_m
            clouds[i] = transform_points(model_from_world[i], views[i]).astype(np.float32)
    return AlignedTrack(
        track=track,
        model_from_world=model_from_world,
        model_points=np.concatenate([clouds[i] for i in range(len(views))]),
        model_view=np.repeat(np.arange(len(views)), [len(view) for view in views]).astype(np.int32),
        model_yaw=float(headings[target_view]),
        target_view=target_view,
        error_m=error_m,
    )


def _to_center(view: Float64Array) -> Float64Array:
    transform = np.eye(4)
    transform[:3, 3] = -view.mean(axis=0)
    return transform


def _turn_rad(alignment: Alignment, start: Float64Array) -> float:
    return float(abs(wrap_angle(yaw_of(alignment.target_from_source) - yaw_of(start))))


def _shift_m(alignment: Alignment, start: Float64Array) -> float:
    return float(np.linalg.norm((alignment.target_from_source - start)[:2, 3]))


def _as_it_lies(view: Float64Array, model: Float32Array, place: Float64Array, params: RegistrationParams) -> Alignment:
    error_m = alignment_errors(_speakers(view, params), model, place[None], params.icp_cutoff_m)
    return Alignment(place, float(error_m[0]))


def _held_by_flow(
    view: Float64Array, model: Float32Array, alignment: Alignment, start: Float64Array, params: RegistrationParams
) -> Alignment | None:
    """Return the alignment of a view that slides, its way from the start along its side taken back; None: it does not.

    A long side fits as well a little farther along itself (aperture): its error hardly rises when it is moved that way.
    """
    source = _speakers(view, params)
    offset = source[:, :2] - source[:, :2].mean(axis=0)
    spread, axes = np.linalg.eigh(offset.T @ offset)
    if spread[1] < LONG_RATIO**2 * spread[0]:
        return None
    transform = alignment.target_from_source
    axis = transform[:3, :2] @ axes[:, 1]
    slid_m = float((transform - start)[:3, 3] @ axis)
    shifted = np.tile(transform, (3, 1, 1))
    shifted[:, :3, 3] += np.outer([SLIDE_M, -SLIDE_M, -slid_m], axis)
    *farther_m, held_m = alignment_errors(source, model, shifted, params.icp_cutoff_m)
    if min(farther_m) - alignment.error_m >= SLIDE_RISE_M:
        return None
    return Alignment(shifted[2], float(held_m))


def _speakers(view: Float64Array, params: RegistrationParams) -> Float64Array:
    """Return those of a view's points that are aligned, view moved to its centroid."""
    return (view - view.mean(axis=0))[spread_points(view, params.max_source_points, dense_from=DENSE_VIEW)]


def _align_view(view: Float64Array, model: Float32Array, starts: Float64Array, params: RegistrationParams) -> Alignment:
    """Align a view, moved to its centroid, with the model."""
    return align(
        _speakers(view, params),
        model,
        starts,
        iterations=params.icp_iterations,
        cutoff_m=params.icp_cutoff_m,
        is_constrained=params.has("upright"),
        num_refined=params.num_refined_starts if params.has("few_starts") else len(starts),
    )


def _grid_starts(turn: float, target_box: Float64Array, params: RegistrationParams) -> Float64Array:
    """Return (25, 4, 4) starts on a 5 x 5 grid over the target box, or the one in its middle. Centroids are at zero."""
    steps = np.linspace(-0.5, 0.5, 5) if params.has("translation_grid") else np.zeros(1)
    along, across = np.meshgrid(steps * target_box[BOX_LENGTH], steps * target_box[BOX_WIDTH], indexing="ij")
    cos, sin = np.cos(target_box[BOX_YAW]), np.sin(target_box[BOX_YAW])
    offsets = np.stack([along * cos - across * sin, along * sin + across * cos, np.zeros_like(along)], axis=-1)
    return np.stack([yaw_translation(turn, offset) for offset in offsets.reshape(-1, 3)])


def _motion_start(track: Track, view: int, neighbor: int, model_from_neighbor: Float64Array) -> Float64Array:
    """Return where the view lies if it moved from its aligned neighbour by the mean of their flows. Centred source."""
    a, b = track.proposals[view], track.proposals[neighbor]
    moved = a.points_world.mean(axis=0) + _way(track, view, neighbor)
    turn = float(wrap_angle(b.box_visible[BOX_YAW] - a.box_visible[BOX_YAW]))
    if abs(turn) > np.pi / 4:  # headings of slow objects are noise
        turn = 0.0
    return model_from_neighbor @ yaw_translation(turn, moved)


def _way(track: Track, view: int, neighbor: int) -> Float64Array:
    """Return the (3,) way from a view to its neighbour by the mean of their flows. World axes."""
    a, b = track.proposals[view], track.proposals[neighbor]
    return (a.velocity_mps + b.velocity_mps) / 2 * seconds_between(b.timestamp_ns, a.timestamp_ns)


def _thin(points: Float32Array, max_points: int) -> Float32Array:
    kept = points[np.sort(group_by_voxel(points, MODEL_VOXEL_M).first_point)] if len(points) > max_points else points
    return kept[spread_rows(len(kept), max_points)]


def longest_view_m(track: Track) -> float:
    """Return the longest side that any view shows."""
    return float(max(proposal.box_visible[[BOX_LENGTH, BOX_WIDTH]].max() for proposal in track.proposals))


def model_to_world(model_from_world: Float64Array) -> Float64Array:
    """Return (T, 4, 4) inverses."""
    return np.stack([invert(transform) for transform in model_from_world])
