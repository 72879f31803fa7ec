"""Pictures of label folders: one sweep seen from above, its most visible objects enlarged below.

Points of the ground are faint, standing ones grey, moving ones coloured by their flow: the hue is the direction, the
brightness the speed. Boxes take the colour of their own velocity, so a box that disagrees with its points stands out.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from labeling.folders.folder import LabelFolder
from labeling.geometry.boxes import bev_corners, to_box_frame, transform_boxes
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, rotate_vectors, transform_points
from labeling.readers.reader import SegmentReader
from labeling.stages.ground import segment_ground
from schemas.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from schemas.config import GroundParams
from schemas.errors import InvalidInput
from schemas.frames import Sweep
from schemas.objects import BOX_LENGTH
from schemas.tables import labels, points, sweeps
from schemas.tables.labels import LabelRows

WIDTH_PX: Final = 1800
HEIGHT_PX: Final = 1400
DPI: Final = 100

GAP_PX: Final = 22  # between panels and around them
MAP_PX: Final = (GAP_PX, 412, WIDTH_PX - 2 * GAP_PX, 932)  # left, bottom, width, height
ABOVE_PX: Final = (172, 190)  # bottom and height of the views from above, and below of those from the side
SIDE_PX: Final = (20, 146)

REACH_X_M: Final = 58.0  # ahead and behind
REACH_Y_M: Final = REACH_X_M * MAP_PX[3] / MAP_PX[2]  # to each side
RING_STEP_M: Final = 10.0
TAIL_S: Final = 2.0  # of each track's past
NUM_ENLARGED: Final = 5
MARGIN_M: Final = 0.7  # around an enlarged object
NAME_M: Final = (7.5, 1.4)  # width and height of a name, with some air, at the map's scale

BACKGROUND: Final = "#0b0e14"
PANEL: Final = "#10151f"
GROUND: Final = (0.27, 0.31, 0.37)
STANDING: Final = (0.50, 0.54, 0.60)
TEXT: Final = "#d8dee9"
FAINT_TEXT: Final = "#6b7688"
LINE: Final = "#26303f"


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """All that is drawn. Ego frame of the sweep, m and m/s."""

    points: FloatArray  # (N, 3)
    is_ground: BoolArray  # (N,)
    is_dynamic: BoolArray  # (N,) called neither ground nor static by the run
    point_velocity: Float64Array  # (N, 3) from the flow; NaN where there is none
    boxes: Float64Array  # (B, 7)
    visible_boxes: Float64Array  # (B, 7) NaN where interpolated
    box_velocity: Float64Array  # (B, 3)
    score: Float64Array  # (B,)
    num_points: Int64Array  # (B,)
    is_observed: BoolArray  # (B,)
    track_ids: list[str]
    tails: list[Float64Array]  # B arrays (R, 3), oldest first
    min_score: float

    @property
    def is_recommended(self) -> BoolArray:
        """(B,) True where the score reaches the recommended cut."""
        return self.score >= self.min_score

    @property
    def is_on_map(self) -> BoolArray:
        """(B,) True where the centre lies on the map."""
        return (np.abs(self.boxes[:, 0]) <= REACH_X_M) & (np.abs(self.boxes[:, 1]) <= REACH_Y_M)


def render_sweep(reader: SegmentReader, folder: LabelFolder, sweep_index: int, path: Path) -> None:
    """Draw one sweep of a label folder as a PNG of 1800 x 1400 pixels; folders above ``path`` are made.

    Without a points table (labels written without ``--points``) there is no flow: boxes stand over grey points.

    Raises:
        InvalidInput: No such sweep, no labels of this segment in the folder, or ``path`` cannot be written.
        UnreadableSweep: The sweep itself cannot be read.

    """
    num_sweeps = len(reader.timestamps_ns)
    if not 0 <= sweep_index < num_sweeps:
        raise InvalidInput(f"sweep {sweep_index} is not in {reader.uri}: it has sweeps 0 to {num_sweeps - 1}")
    table = folder.table("labels", reader.segment_id)
    if table is None:
        raise InvalidInput(f"the label folder holds nothing of segment {reader.segment_id}: was it labelled there?")
    scene = _read_scene(reader, folder, labels.from_table(table), sweep_index)

    figure = Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    main = _panel(figure, *MAP_PX)
    max_speed_mps = _top_of_scale(scene)
    _draw_map(main, scene, max_speed_mps)
    _draw_wheel(main.inset_axes((0.908, 0.79, 0.084, 0.19)), max_speed_mps)
    width_px = (WIDTH_PX - (NUM_ENLARGED + 1) * GAP_PX) // NUM_ENLARGED
    for place, row in enumerate(_most_visible(scene)):
        left_px = GAP_PX + place * (width_px + GAP_PX)
        above = _panel(figure, left_px, ABOVE_PX[0], width_px, ABOVE_PX[1])
        side = _panel(figure, left_px, SIDE_PX[0], width_px, SIDE_PX[1])
        _draw_object(above, side, scene, row, max_speed_mps)
    _write_title(figure, reader, scene, sweep_index)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, facecolor=BACKGROUND, format="png")
    except OSError as error:
        raise InvalidInput(f"cannot write the picture {path}: {error.strerror or error}") from None


# ---------------------------------------------------------------------------------------------------- what is drawn


def _read_scene(reader: SegmentReader, folder: LabelFolder, of_segment: LabelRows, sweep_index: int) -> _Scene:
    sweep = reader.read_sweep(sweep_index)
    _check_same_sweep(reader, folder, sweep)
    ego_from_world = invert(sweep.world_from_ego)
    rows = of_segment.take(of_segment.sweep_index == sweep_index)
    track_ids: list[str] = rows.track_id.tolist()
    is_dynamic, point_velocity = _point_motion(reader, folder, sweep)
    return _Scene(
        points=sweep.points_ego,
        is_ground=segment_ground(sweep.points_ego, GroundParams(), np.random.default_rng(0)).is_ground & ~is_dynamic,
        is_dynamic=is_dynamic,
        point_velocity=point_velocity,
        boxes=transform_boxes(ego_from_world, rows.boxes),
        visible_boxes=transform_boxes(ego_from_world, rows.boxes_visible),
        box_velocity=rotate_vectors(ego_from_world, rows.velocity_mps),
        score=rows.score,
        num_points=rows.num_points,
        is_observed=rows.is_observed,
        track_ids=track_ids,
        tails=[_tail(of_segment, track_id, sweep, ego_from_world) for track_id in track_ids],
        min_score=folder.recommended_min_score,
    )


def _check_same_sweep(reader: SegmentReader, folder: LabelFolder, sweep: Sweep) -> None:
    """Raise unless the labels were made from as many points: else rows of the points table mean other points."""
    table = folder.table("sweeps", reader.segment_id)
    observations = [] if table is None else sweeps.from_table(table)
    labelled = [observed.num_points for observed in observations if observed.sweep_index == sweep.index]
    if labelled != [sweep.num_points]:
        told = f"its labels were made from {labelled[0]}" if labelled else "it was not labelled"
        raise InvalidInput(
            f"sweep {sweep.index} of {reader.uri} has {sweep.num_points} points, but {told}: was the range shorter, or "
            "the recording changed since?"
        )


def _point_motion(reader: SegmentReader, folder: LabelFolder, sweep: Sweep) -> tuple[BoolArray, Float64Array]:
    """Return which points the run called dynamic, and their velocities (NaN where no flow is known)."""
    is_dynamic = np.zeros(sweep.num_points, dtype=bool)
    velocity = np.full((sweep.num_points, 3), np.nan)
    table = folder.table("points", reader.segment_id)
    if table is not None:
        rows = points.from_table(table.filter(pc.field("sweep_index") == sweep.index))
        is_dynamic[rows.point_index] = True
        if sweep.index + 1 < len(reader.timestamps_ns):
            gap_s = seconds_between(int(reader.timestamps_ns[sweep.index + 1]), int(reader.timestamps_ns[sweep.index]))
            velocity[rows.point_index] = rotate_vectors(invert(sweep.world_from_ego), rows.flow_world_m) / gap_s
    return is_dynamic, velocity


def _tail(rows: LabelRows, track_id: str, sweep: Sweep, ego_from_world: Float64Array) -> Float64Array:
    """Return the track's centres of the last TAIL_S up to this sweep, seen from where the vehicle is now."""
    is_recent = rows.timestamp_ns >= sweep.timestamp_ns - int(TAIL_S * 1e9)
    tail = rows.take((rows.track_id == track_id) & (rows.sweep_index <= sweep.index) & is_recent)
    tail = tail.take(np.argsort(tail.timestamp_ns, kind="stable"))
    return transform_points(ego_from_world, tail.boxes[:, :BOX_LENGTH])


def _most_visible(scene: _Scene) -> list[int]:
    """Return the recommended, observed boxes within the map with the most points, from left to right on it."""
    candidates = np.flatnonzero(scene.is_recommended & scene.is_observed & scene.is_on_map)
    chosen = candidates[np.argsort(-scene.num_points[candidates], kind="stable")][:NUM_ENLARGED]
    return [int(row) for row in chosen[np.argsort(scene.boxes[chosen, 0], kind="stable")]]


# -------------------------------------------------------------------------------------------------------- colours


def _top_of_scale(scene: _Scene) -> float:
    """Return the speed of full brightness: that of the fastest recommended box, in steps of 5 m/s."""
    speed = np.linalg.norm(scene.box_velocity[scene.is_recommended, :2], axis=1)
    return float(np.clip(5 * np.ceil(speed.max(initial=5.0) / 5), 5, 30))


def _colors(velocity: Float64Array, max_speed_mps: float, darkest: float = 0.45) -> Float64Array:
    """Return (N, 3) RGB of (N, >= 2) velocities: hue of the direction, brightness and saturation of the speed."""
    share = np.clip(np.linalg.norm(velocity[:, :2], axis=1) / max_speed_mps, 0, 1) ** 0.6
    hue = np.mod(np.arctan2(velocity[:, 1], velocity[:, 0]) / (2 * np.pi), 1.0)
    rgb: Float64Array = hsv_to_rgb(np.stack([hue, 0.15 + 0.75 * share, darkest + (1 - darkest) * share], axis=1))
    return rgb


# ---------------------------------------------------------------------------------------------------------- the map


def _draw_map(axes: Axes, scene: _Scene, max_speed_mps: float) -> None:
    axes.set_xlim(-REACH_X_M, REACH_X_M)
    axes.set_ylim(-REACH_Y_M, REACH_Y_M)
    for radius in np.arange(RING_STEP_M, np.hypot(REACH_X_M, REACH_Y_M), RING_STEP_M):
        axes.add_patch(Circle((0, 0), radius, fill=False, color=LINE, lw=0.8, zorder=0))
        for sign in (-1, 1):
            if radius < REACH_X_M and radius % 20 == 0:
                axes.text(sign * radius, 0.3, f"{radius:.0f} m", color=FAINT_TEXT, fontsize=9, ha="center", zorder=1)
    is_standing = ~scene.is_ground & ~scene.is_dynamic
    _scatter(axes, scene.points[scene.is_ground], np.array([GROUND]), 0.25)
    _scatter(axes, scene.points[is_standing], np.array([STANDING]), 0.8)
    _scatter(axes, scene.points[scene.is_dynamic], _point_colors(scene, max_speed_mps)[scene.is_dynamic], 4.0)
    _draw_vehicle(axes)
    box_colors = _colors(scene.box_velocity, max_speed_mps, darkest=0.7)
    for row in range(len(scene.boxes)):
        _draw_tail(axes, scene.tails[row], box_colors[row], is_faint=not scene.is_recommended[row])
        _draw_box(axes, scene, row, box_colors[row])
    _draw_names(axes, scene, box_colors)
    axes.text(
        0.006, 0.012, f"boxes: solid seen, dashed interpolated, thin below score {scene.min_score:.2f};"
        f" tails: last {TAIL_S:.0f} s; vehicle drives to the right",
        transform=axes.transAxes, color=FAINT_TEXT, fontsize=9, zorder=8,
    )  # fmt: skip


def _point_colors(scene: _Scene, max_speed_mps: float) -> Float64Array:
    """Return (N, 3): by flow where it is known, white for dynamic points without, grey for the rest."""
    colors = np.tile(np.array(STANDING), (len(scene.points), 1))
    colors[scene.is_ground] = GROUND
    colors[scene.is_dynamic] = 0.85
    has_flow = np.isfinite(scene.point_velocity).all(axis=1)
    colors[has_flow] = _colors(scene.point_velocity[has_flow], max_speed_mps)
    return colors


def _draw_box(axes: Axes, scene: _Scene, row: int, color: Float64Array) -> None:
    box, is_recommended = scene.boxes[row], scene.is_recommended[row]
    width = 1.8 if is_recommended else 0.7
    alpha = 1.0 if is_recommended and scene.is_observed[row] else 0.55
    style = "-" if scene.is_observed[row] else (0, (3, 2))
    corners = bev_corners(box[None])[0]
    axes.add_patch(Polygon(corners, closed=True, fill=False, ec=color, lw=width, ls=style, alpha=alpha, zorder=5))
    front = corners[[0, 3]].mean(axis=0)
    heading = np.array([np.cos(box[6]), np.sin(box[6])])
    axes.plot(*np.stack([box[:2], front + 0.6 * heading]).T, color=color, lw=width, alpha=alpha, zorder=5)


def _draw_names(axes: Axes, scene: _Scene, colors: Float64Array) -> None:
    """Write id and speed above each recommended box, or below it where another name already stands."""
    taken: list[tuple[float, float]] = []
    for row in np.flatnonzero(scene.is_recommended & scene.is_on_map):
        corners = bev_corners(scene.boxes[row : row + 1])[0]
        x, above, below = corners[:, 0].mean(), corners[:, 1].max() + 0.5, corners[:, 1].min() - 1.4
        is_free = all(abs(x - other[0]) > NAME_M[0] or abs(above - other[1]) > NAME_M[1] for other in taken)
        y = above if is_free else below
        taken.append((x, y))
        speed_mps = np.linalg.norm(scene.box_velocity[row, :2])
        axes.text(
            x, y, f"{scene.track_ids[row][:4]}  {speed_mps:.1f} m/s", color=colors[row], fontsize=10,
            alpha=1.0 if scene.is_observed[row] else 0.75, ha="center", zorder=7, clip_on=True,
        )  # fmt: skip


def _draw_tail(axes: Axes, tail: Float64Array, color: Float64Array, *, is_faint: bool) -> None:
    if len(tail) >= 2:
        steps = np.stack([tail[:-1, :2], tail[1:, :2]], axis=1)
        alpha = np.arange(1, len(steps) + 1) / len(steps) * (0.3 if is_faint else 0.9)
        axes.add_collection(LineCollection(list(steps), colors=[(*color, a) for a in alpha], linewidths=2.0, zorder=4))


def _draw_vehicle(axes: Axes) -> None:
    axes.add_patch(Rectangle((-2.3, -0.95), 4.6, 1.9, fc="#2b3545", ec=TEXT, lw=1.2, zorder=6))
    axes.add_patch(Polygon([[1.9, 0.0], [0.6, 0.6], [0.6, -0.6]], closed=True, fc=TEXT, zorder=6))


def _draw_wheel(axes: Axes, max_speed_mps: float) -> None:
    """Draw the legend: right is the vehicle's direction of travel, the rim the highest speed."""
    grid = np.linspace(-1, 1, 161)
    x, y = np.meshgrid(grid, grid)
    rgb = _colors(np.stack([x.ravel(), y.ravel()], axis=1) * max_speed_mps, max_speed_mps)
    is_inside = (np.hypot(x, y) <= 1).astype(np.float64)
    axes.imshow(np.dstack([rgb.reshape(161, 161, 3), is_inside]), extent=(-1, 1, -1, 1), origin="lower")
    axes.set_axis_off()
    axes.set_xlim(-1.15, 1.15)
    axes.set_ylim(-1.5, 1.15)
    axes.text(0, -1.18, f"rim: {max_speed_mps:.0f} m/s", color=TEXT, fontsize=10, ha="center", va="top")


# ---------------------------------------------------------------------------------------------------- single objects


def _draw_object(above: Axes, side: Axes, scene: _Scene, row: int, max_speed_mps: float) -> None:
    """Draw one object in its own frame, heading to the right: from above, and below that from its right side."""
    box = scene.boxes[row]
    length, width, height = box[3:6]
    panel_px = above.get_window_extent()
    m_per_px = max(
        (length + 2 * MARGIN_M) / panel_px.width,
        (width + 2 * MARGIN_M) / ABOVE_PX[1],
        (height + 2 * MARGIN_M) / SIDE_PX[1],
    )
    local = to_box_frame(scene.points, box)
    shown_m = (panel_px.width * m_per_px / 2, width / 2 + MARGIN_M, height / 2 + MARGIN_M)
    is_near = (np.abs(local) <= shown_m).all(axis=1)
    local, colors = local[is_near], _point_colors(scene, max_speed_mps)[is_near]
    edge = _colors(scene.box_velocity[row : row + 1], max_speed_mps, darkest=0.7)[0]
    visible = scene.visible_boxes[row]
    for axes, up, extent, height_px in ((above, 1, width, ABOVE_PX[1]), (side, 2, height, SIDE_PX[1])):
        axes.scatter(local[:, 0], local[:, up], s=5, c=colors, linewidths=0, zorder=2)
        axes.add_patch(Rectangle((-length / 2, -extent / 2), length, extent, fill=False, ec=edge, lw=1.6, zorder=3))
        axes.set_xlim(-shown_m[0], shown_m[0])
        axes.set_ylim(-height_px * m_per_px / 2, height_px * m_per_px / 2)
    if np.isfinite(visible).all():
        seen = to_box_frame(np.column_stack([bev_corners(visible[None])[0], np.full(4, visible[2])]), box)
        above.add_patch(Polygon(seen[:, :2], closed=True, fill=False, ec=TEXT, lw=0.8, ls=":", zorder=3))
    above.plot([0, length / 2 + 0.5], [0, 0], color=edge, lw=1.4, zorder=3)
    speed_mps = np.linalg.norm(scene.box_velocity[row, :2])
    above.set_title(
        f"{scene.track_ids[row][:4]}   {speed_mps:.1f} m/s   score {scene.score[row]:.2f}\n"
        f"{length:.1f} x {width:.1f} x {height:.1f} m   {scene.num_points[row]:.0f} points",
        color=edge, fontsize=9.5, pad=4,
    )  # fmt: skip


# -------------------------------------------------------------------------------------------------------- small parts


def _panel(figure: Figure, left_px: float, bottom_px: float, width_px: float, height_px: float) -> Axes:
    axes = figure.add_axes(
        (left_px / WIDTH_PX, bottom_px / HEIGHT_PX, width_px / WIDTH_PX, height_px / HEIGHT_PX), facecolor=PANEL
    )
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(LINE)
    return axes


def _scatter(axes: Axes, points: FloatArray, colors: FloatArray, size: float) -> None:
    is_inside = (np.abs(points[:, 0]) <= REACH_X_M) & (np.abs(points[:, 1]) <= REACH_Y_M)
    shown = colors[is_inside] if len(colors) == len(points) > 1 else colors
    axes.scatter(points[is_inside, 0], points[is_inside, 1], s=size, c=shown, linewidths=0, zorder=2)


def _write_title(figure: Figure, reader: SegmentReader, scene: _Scene, sweep_index: int) -> None:
    seconds = seconds_between(int(reader.timestamps_ns[sweep_index]), int(reader.timestamps_ns[0]))
    speed_mps = np.linalg.norm(scene.box_velocity[:, :2], axis=1)
    num_moving = int((scene.is_recommended & (speed_mps > 1.0)).sum())
    figure.text(
        GAP_PX / WIDTH_PX, 0.972, f"{reader.dataset}   {reader.segment_id}", color=TEXT, fontsize=15, weight="bold"
    )
    figure.text(
        1 - GAP_PX / WIDTH_PX, 0.972, f"sweep {sweep_index} of {len(reader.timestamps_ns)}   t = {seconds:.2f} s   "
        f"{len(scene.points):,} points   {int(scene.is_recommended.sum())} objects, {num_moving} faster than 1 m/s",
        color=TEXT, fontsize=12, ha="right",
    )  # fmt: skip
