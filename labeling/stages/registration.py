"""Registration: the views of a track -> one cloud, and how each view lies on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labeling.geometry.axes import long_axes
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, transform_points, wrap_angle, yaw_of, yaw_translation
from labeling.geometry.voxels import group_by_voxel, spread_points, spread_rows
from labeling.stages.icp import Alignment, Target, align
from schemas.arrays import Float64Array
from schemas.config import RegistrationParams
from schemas.objects import BOX_LENGTH, BOX_WIDTH, BOX_YAW, AlignedTrack, Proposal, Track

MODEL_VOXEL_M = 0.05  # the growing target is thinned to this
JOINT_POINTS = 4096  # of all views together: those of the other views are what each one is aligned with again
USUAL_VIEWS = 9  # aligned last, whose errors say what to expect of the next one
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
    stays unless another start ends with an error less by ``motion_margin_m``: a flat side slides along itself. A view
    that lies there as well as most before it is not looked for elsewhere. Of an object longer than MIN_SLIDE_LENGTH_M,
    a side that fits anywhere lies along itself where the flow led. A vehicle's view turns no farther than MAX_TURN_RAD
    from there: one side fits on another, and all later views would follow. None lies farther from there than flow led,
    or MAX_JUMP_M: a side fits on itself after any slide.

    The cost of a view does not depend on how many there are.

    """
    views = [_View.of(proposal, params) for proposal in track.proposals]
    target_view = int(np.argmax([len(view.points) for view in views]))
    order = [(i, i - 1) for i in range(target_view + 1, len(views))]
    order += [(i, i + 1) for i in range(target_view - 1, -1, -1)]
    search = _Search.on(views[target_view], longest_view_m(track), params)

    model_from_view = np.tile(np.eye(4), (len(views), 1, 1))
    error_m = np.full(len(views), np.nan)
    model = _thin([views[target_view].points], params)
    for done, (i, neighbor) in enumerate(order):
        recent = [error_m[k] for k, _ in order[max(0, done - USUAL_VIEWS) : done]]
        usual_m = float(np.median(recent)) if recent else 0.0
        alignment = search.find(views[i], Target.of(model), views[neighbor], model_from_view[neighbor], usual_m)
        model_from_view[i], error_m[i] = alignment.target_from_source, alignment.error_m
        model = _thin([model, transform_points(model_from_view[i], views[i].points)], params)

    samples = [view.points[spread_rows(len(view.points), max(1, JOINT_POINTS // len(views)))] for view in views]
    laid = [transform_points(pose, sample) for pose, sample in zip(model_from_view, samples, strict=True)]
    for _ in range(params.joint_rounds if len(views) > 2 and params.has("joint_rounds") else 0):
        for i, _ in order:
            others = Target.of(_thin([*laid[:i], *laid[i + 1 :]], params))
            alignment, _ = search.improve(views[i], others, model_from_view[i])
            model_from_view[i], error_m[i] = alignment.target_from_source, alignment.error_m
            laid[i] = transform_points(model_from_view[i], samples[i])

    clouds = [transform_points(pose, view.points) for pose, view in zip(model_from_view, views, strict=True)]
    return AlignedTrack(
        track=track,
        model_from_world=np.stack(
            [m @ yaw_translation(0.0, -view.center) for m, view in zip(model_from_view, views, strict=True)]
        ),
        model_points=np.concatenate(clouds).astype(np.float32),
        model_view=np.repeat(np.arange(len(views)), [len(view.points) for view in views]).astype(np.int32),
        model_yaw=float(track.proposals[target_view].box_visible[BOX_YAW]),
        target_view=target_view,
        error_m=error_m,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A proposal and its points, moved to their centroid."""

    proposal: Proposal
    center: Float64Array  # (3,) world
    points: Float64Array  # (N, 3)
    speakers: Float64Array  # (S, 3) those that are aligned

    @classmethod
    def of(cls, proposal: Proposal, params: RegistrationParams) -> "_View":
        center = proposal.points_world.mean(axis=0)
        points = proposal.points_world - center
        speakers = points[spread_points(points, params.max_source_points, dense_from=DENSE_VIEW)]
        return cls(proposal, center, points, speakers)

    @property
    def yaw(self) -> float:
        return float(self.proposal.box_visible[BOX_YAW])


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """How the views of one track are looked for."""

    params: RegistrationParams
    target: _View  # the densest
    max_turn_rad: float
    may_slide: bool

    @classmethod
    def on(cls, target: _View, longest_m: float, params: RegistrationParams) -> "_Search":
        max_turn_rad = MAX_TURN_RAD if longest_m >= MIN_STIFF_LENGTH_M else np.pi
        may_slide = params.has("slide_test") and params.has("motion_start") and longest_m >= MIN_SLIDE_LENGTH_M
        return cls(params, target, max_turn_rad, may_slide)

    def find(
        self, view: _View, model: Target, neighbor: _View, model_from_neighbor: Float64Array, usual_m: float
    ) -> Alignment:
        """Return how a view lies on the model: where flow led, unless a start of the grid explains it better."""
        if not self.params.has("motion_start"):
            return self._align(view, model, self._grid(view))
        way = _way(view.proposal, neighbor.proposal)
        start = _led_by_flow(view, neighbor, way, model_from_neighbor)
        led, slides = self.improve(view, model, start)
        margin_m = self.params.motion_margin_m
        if slides or led.error_m <= usual_m + margin_m:
            return led
        found = self._align(view, model, self._grid(view))
        max_jump_m = max(MAX_JUMP_M, float(np.hypot(*way[:2])))
        is_possible = _turn_rad(found, start) <= self.max_turn_rad and _shift_m(found, start) <= max_jump_m
        return found if is_possible and found.error_m < led.error_m - margin_m else led

    def improve(self, view: _View, model: Target, start: Float64Array) -> tuple[Alignment, bool]:
        """Return what ICP makes of a start; True with a view that slides: it is taken back to there along its side."""
        alignment = self._align(view, model, start[None])
        if _turn_rad(alignment, start) > self.max_turn_rad:
            alignment = Alignment(start, float(self._errors_m(view, model, start[None])[0]))
        axes = long_axes(view.speakers)
        if not self.may_slide or not axes.is_long(LONG_RATIO)[0]:
            return alignment, False
        return self._hold(view, model, alignment, start, axes.direction[0])

    def _hold(
        self, view: _View, model: Target, alignment: Alignment, start: Float64Array, side: Float64Array
    ) -> tuple[Alignment, bool]:
        """Take a view that slides back to its start along its side, (2,).

        A long side fits as well a little farther along itself (aperture): its error hardly rises when it is moved so.
        """
        transform = alignment.target_from_source
        axis = transform[:3, :2] @ side
        slid_m = float((transform - start)[:3, 3] @ axis)
        shifted = np.tile(transform, (3, 1, 1))
        shifted[:, :3, 3] += np.outer([SLIDE_M, -SLIDE_M, -slid_m], axis)
        *farther_m, held_m = self._errors_m(view, model, shifted)
        slides = min(farther_m) - alignment.error_m < SLIDE_RISE_M
        return (Alignment(shifted[2], float(held_m)), True) if slides else (alignment, False)

    def _align(self, view: _View, model: Target, starts: Float64Array) -> Alignment:
        return align(
            view.speakers,
            model,
            starts,
            iterations=self.params.icp_iterations,
            cutoff_m=self.params.icp_cutoff_m,
            is_constrained=self.params.has("upright"),
            num_refined=self.params.num_refined_starts if self.params.has("few_starts") else len(starts),
        )

    def _errors_m(self, view: _View, model: Target, places: Float64Array) -> Float64Array:
        return model.errors_m(view.speakers, places, self.params.icp_cutoff_m)

    def _grid(self, view: _View) -> Float64Array:
        """Return (25, 4, 4) starts on a 5 x 5 grid over the target box, or the one in its middle."""
        turn = float(wrap_angle(self.target.yaw - view.yaw)) if self.params.has("rotation_start") else 0.0
        steps = np.linspace(-0.5, 0.5, 5) if self.params.has("translation_grid") else np.zeros(1)
        box = self.target.proposal.box_visible
        along, across = np.meshgrid(steps * box[BOX_LENGTH], steps * box[BOX_WIDTH], indexing="ij")
        cos, sin = np.cos(self.target.yaw), np.sin(self.target.yaw)
        offsets = np.stack([along * cos - across * sin, along * sin + across * cos, np.zeros_like(along)], axis=-1)
        return np.stack([yaw_translation(turn, offset) for offset in offsets.reshape(-1, 3)])


def _way(view: Proposal, neighbor: Proposal) -> Float64Array:
    """Return the (3,) way from a view to its neighbour by the mean of their flows. World axes."""
    gap_s = seconds_between(neighbor.timestamp_ns, view.timestamp_ns)
    return (view.velocity_mps + neighbor.velocity_mps) / 2 * gap_s


def _led_by_flow(view: _View, neighbor: _View, way: Float64Array, model_from_neighbor: Float64Array) -> Float64Array:
    """Return where the view lies if it went this way from its aligned neighbour."""
    turn = float(wrap_angle(neighbor.yaw - view.yaw))
    if abs(turn) > np.pi / 4:  # headings of slow objects are noise
        turn = 0.0
    return model_from_neighbor @ yaw_translation(turn, view.center + way - neighbor.center)


def _turn_rad(alignment: Alignment, start: Float64Array) -> float:
    return float(abs(wrap_angle(yaw_of(alignment.target_from_source) - yaw_of(start))))


def _shift_m(alignment: Alignment, start: Float64Array) -> float:
    return float(np.linalg.norm((alignment.target_from_source - start)[:2, 3]))


def _thin(clouds: Sequence[Float64Array], params: RegistrationParams) -> Float64Array:
    """Return (Q, 3) points of all clouds, of those that share a voxel the first, ``max_target_points`` at most."""
    points = np.concatenate(clouds)
    if len(points) > params.max_target_points:
        points = points[np.sort(group_by_voxel(points, MODEL_VOXEL_M).first_point)]
    return points[spread_rows(len(points), params.max_target_points)]


def longest_view_m(track: Track) -> float:
    """Return the longest side that any view shows."""
    return float(max(proposal.box_visible[[BOX_LENGTH, BOX_WIDTH]].max() for proposal in track.proposals))


def model_to_world(model_from_world: Float64Array) -> Float64Array:
    """Return (T, 4, 4) inverses."""
    return np.stack([invert(transform) for transform in model_from_world])
