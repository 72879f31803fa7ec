"""Where the vehicle was at each sweep: a row a sweep, or rows with times, between which is interpolated."""

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from labeling.geometry.transforms import invert, rotation_from_quaternion
from labeling.readers.folder.description import METRES, STANDARD_AXES, Description, axes_matrix
from labeling.readers.folder.stamps import TimedSweeps, rows_of_sweeps
from labeling.readers.folder.text import TIME_NAMES, Table, parse_table, time_ns, unit_of
from schemas.arrays import Float64Array, Int64Array
from schemas.errors import InvalidInput

MAX_GAP_S: Final = 0.25  # between two poses with a sweep between: a vehicle that turns is told no worse than 5 cm
EDGE_S: Final = 0.001  # before the first pose or after the last: what rounding does to a time
MAX_ROUNDING: Final = 1e-2  # of what is a rotation, in its product with its transpose
EXACT: Final = 1e-6
MIN_UPRIGHT: Final = 0.5  # cosine of how the vehicle leans
MIN_CLIMB_M: Final = 2.0
MAX_SLOPE: Final = 1.0  # of the way from the first pose to the last; with more, the axes are others
_POSITION: Final = (("x", "tx", "tx_m", "px", "pos_x", "position_x"), ("y", "ty", "ty_m", "py", "pos_y", "position_y"),
                    ("z", "tz", "tz_m", "pz", "pos_z", "position_z"))  # fmt: skip
_QUATERNION: Final = (("qw", "rot_w", "orientation_w"), ("qx", "rot_x", "orientation_x"),
                      ("qy", "rot_y", "orientation_y"), ("qz", "rot_z", "orientation_z"))  # fmt: skip
_ANGLES: Final = ("roll", "pitch", "yaw")  # rad
_ROW: Final = "12 numbers (KITTI), 16 (4x4) or 8 (TUM: t x y z qx qy qz qw)"


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """The poses of a file as they stand there; NaN where a row is none."""

    transforms: Float64Array  # (P, 4, 4)
    times_ns: Int64Array | None  # (P,) None: rows belong to sweeps
    is_camera: bool = False  # rows of 12 numbers, as KITTI writes them for a camera


@dataclass(frozen=True, slots=True, eq=False)
class SweepPoses:
    """A pose for each sweep that has one, and the reason for each that has none."""

    world_from_ego: Float64Array  # (T, 4, 4)
    reasons: dict[int, str]


def parse_poses(content: bytes, name: str, place: str, description: Description) -> PoseRows:
    """Return the poses of a file: .npy, or text in any of the usual layouts.

    Raises:
        InvalidInput: It is of no known layout.

    """
    if name.endswith(".npy"):
        return PoseRows(_checked(_matrices(_load(content, place), place)), None)
    table = parse_table(content, place)
    if table.names and (any(table.column(*names) is not None for names in _POSITION)):
        return _named_poses(table, description)
    return _unnamed_poses(table, description)


def _load(content: bytes, place: str) -> NDArray[np.generic]:
    try:
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, OSError):
        raise InvalidInput(f"{place}: no readable .npy of numbers: truncated, or pickled objects?") from None


def _matrices(array: NDArray[np.generic], place: str) -> Float64Array:
    if array.dtype.kind in "fiu" and array.ndim >= 2 and array.shape[1:] in ((4, 4), (3, 4), (16,), (12,)):
        rows = array.astype(np.float64).reshape(len(array), -1, 4)
        transforms = np.tile(np.eye(4), (len(array), 1, 1))
        transforms[:, :3] = rows[:, :3]
        return transforms
    raise InvalidInput(f"{place}: shape {array.shape}, expected (T, 4, 4), (T, 3, 4), (T, 16) or (T, 12)")


def _unnamed_poses(table: Table, description: Description) -> PoseRows:
    (width, _), *_ = Counter(len(row.cells) for row in table.rows).most_common(1)
    has_time = width in (8, 13, 17)
    if width not in (12, 16) and not has_time:
        raise InvalidInput(f"{table.place}: rows of {width} columns, expected {_ROW}, or a line of names above")
    numbers = np.array([_numbers(row.cells[has_time:], width - has_time) for row in table.rows])
    if width == 8:
        transforms = _transforms(numbers[:, :3], numbers[:, [6, 3, 4, 5]])
    else:
        transforms = _matrices(numbers, table.place)
    return PoseRows(_checked(transforms), _times(table, 0, description) if has_time else None, is_camera=width == 12)


def _named_poses(table: Table, description: Description) -> PoseRows:
    position = [table.column(*names) for names in _POSITION]
    quaternion = [table.column(*names) for names in _QUATERNION]
    angles = [table.column(name) for name in _ANGLES]
    if None in position or (None in quaternion and None in angles):
        raise InvalidInput(
            f"{table.place}: expected columns x, y, z with qw, qx, qy, qz or roll, pitch, yaw (radians); "
            f"it has {', '.join(table.names)}"
        )
    numbers = np.array([_numbers(row.cells, len(table.names), is_lenient=True) for row in table.rows])
    place = numbers[:, [column or 0 for column in position]]
    if None not in quaternion:
        transforms = _transforms(place, numbers[:, [column or 0 for column in quaternion]])
    else:
        rotation_rad = numbers[:, [column or 0 for column in angles]]
        if np.nanmax(np.abs(rotation_rad), initial=0.0) > 2 * np.pi:
            raise InvalidInput(f"{table.place}: roll, pitch or yaw beyond a whole turn: degrees? expected radians")
        has_angles = np.isfinite(rotation_rad).all(axis=1)
        transforms = np.full((len(place), 4, 4), np.nan)
        transforms[has_angles, :3, :3] = Rotation.from_euler("ZYX", rotation_rad[has_angles, ::-1]).as_matrix()
        transforms[:, :3, 3], transforms[:, 3] = place, (0, 0, 0, 1)
    time = table.column(*TIME_NAMES)
    return PoseRows(_checked(transforms), None if time is None else _times(table, time, description))


def _numbers(cells: Sequence[str], width: int, *, is_lenient: bool = False) -> list[float]:
    """Return a row's numbers; NaN for all of a row that is broken, or for what is no number in a lenient one."""
    numbers = []
    for cell in cells:
        try:
            numbers.append(float(cell))
        except ValueError:
            numbers.append(np.nan)
    is_whole = len(numbers) == width and (is_lenient or not np.isnan(numbers).any())
    return numbers if is_whole else [np.nan] * width


def _times(table: Table, column: int, description: Description) -> Int64Array:
    unit = description.poses.unit or unit_of(table.rows[0].cells[column], table.names[column] if table.names else "")
    times = []
    for row in table.rows:
        try:
            times.append(time_ns(row.cells[column], unit))
        except (ValueError, IndexError) as error:
            raise InvalidInput(f"{table.where(row)}: {error}") from None
    return np.array(times, dtype=np.int64)


def _transforms(position: Float64Array, quaternion_wxyz: Float64Array) -> Float64Array:
    transforms = np.tile(np.eye(4), (len(position), 1, 1))
    transforms[:, :3, :3] = rotation_from_quaternion(*quaternion_wxyz.T)
    transforms[:, :3, 3] = position
    return transforms


def _checked(transforms: Float64Array) -> Float64Array:
    """Return poses with NaN for those that are no rotation and place; rotations that were rounded are made exact."""
    rotations = transforms[:, :3, :3]
    with np.errstate(invalid="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        is_rotation = (error < MAX_ROUNDING) & (np.linalg.det(rotations) > 0)
    is_good = is_rotation & np.isfinite(transforms).all(axis=(1, 2))
    checked: Float64Array = np.where(is_good[:, None, None], transforms, np.nan)
    is_rounded = is_good & (error > EXACT)
    if is_rounded.any():
        checked[is_rounded, :3, :3] = Rotation.from_matrix(rotations[is_rounded]).as_matrix()
    return checked


def parse_camera_from_sensor(content: bytes, place: str) -> Float64Array | None:
    """Return (4, 4) of line ``Tr:`` (or ``Tr_velo_to_cam:``) of a KITTI calib.txt, None where there is none."""
    for line in content.decode(errors="replace").splitlines():
        key, _, numbers = line.partition(":")
        if key.strip() in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
            values = _numbers(numbers.split(), 12)
            transform = _checked(_matrices(np.array([values]), place))[0]
            if not np.isfinite(transform).all():
                raise InvalidInput(f"{place}: {key.strip()}: expected 12 numbers of a rotation and a place")
            return transform
    return None


def poses_of_sweeps(
    rows: PoseRows, sweeps: TimedSweeps, description: Description, camera_from_sensor: Float64Array | None, place: str
) -> SweepPoses:
    """Return the vehicle's pose at each sweep.

    Raises:
        InvalidInput: The file speaks of other sweeps, or has other axes.

    """
    if rows.times_ns is None:
        found, reasons = _poses_by_row(rows, sweeps, place)
    else:
        found, reasons = _poses_by_time(rows.transforms, rows.times_ns, sweeps, place)
    if len(reasons) == len(found):
        raise InvalidInput(f"{place}: poses do not cover the sweeps: {reasons[0]}")
    has_pose = np.array([index not in reasons for index in range(len(found))])
    world_from_ego = np.full_like(found, np.nan)
    world_from_ego[has_pose] = _in_ego_axes(found[has_pose], rows, description, camera_from_sensor, place)
    return SweepPoses(world_from_ego, reasons)


def _poses_by_row(rows: PoseRows, sweeps: TimedSweeps, place: str) -> tuple[Float64Array, dict[int, str]]:
    chosen = rows_of_sweeps(len(rows.transforms), sweeps.names, place, "poses")
    found = rows.transforms[chosen]
    is_bad = ~np.isfinite(found).all(axis=(1, 2))
    reasons = {int(k): f"pose {chosen[k]} is not finite, or no rotation" for k in np.flatnonzero(is_bad)}
    return found, reasons


def _poses_by_time(
    transforms: Float64Array, times_ns: Int64Array, sweeps: TimedSweeps, place: str
) -> tuple[Float64Array, dict[int, str]]:
    """Interpolate: places linearly, rotations along the shortest turn."""
    is_good = np.isfinite(transforms).all(axis=(1, 2))
    if not is_good.any():
        raise InvalidInput(f"{place}: no row is a pose: numbers that are not finite, or no rotations")
    known_ns, first = np.unique(times_ns[is_good], return_index=True)
    known = transforms[is_good][first]
    wanted_ns = np.clip(sweeps.timestamps_ns, known_ns[0], known_ns[-1])
    after = np.clip(np.searchsorted(known_ns, wanted_ns), 1 if len(known_ns) > 1 else 0, len(known_ns) - 1)
    before = np.maximum(after - 1, 0)
    away_ns = np.minimum(*(np.abs(known_ns[side] - sweeps.timestamps_ns) for side in (before, after)))
    nearest_s = away_ns * 1e-9
    gap_s = (known_ns[after] - known_ns[before]) * 1e-9
    is_outside = np.abs(wanted_ns - sweeps.timestamps_ns) * 1e-9 > EDGE_S
    is_far = is_outside | ((gap_s > MAX_GAP_S) & (nearest_s > EDGE_S))
    reasons = {
        int(k): f"no pose at {sweeps.timestamps_ns[k]} ns, the nearest is {nearest_s[k]:.3g} s away; poses are from "
        f"{known_ns[0]} to {known_ns[-1]} ns: another clock, or a gap?"
        for k in np.flatnonzero(is_far)
    }
    return _interpolated(known_ns, known, before, after, wanted_ns), reasons


def _interpolated(
    known_ns: Int64Array, known: Float64Array, before: Int64Array, after: Int64Array, wanted_ns: Int64Array
) -> Float64Array:
    found = known[before].copy()
    span_ns = np.maximum(known_ns[after] - known_ns[before], 1)
    share = (wanted_ns - known_ns[before]) / span_ns
    found[:, :3, 3] += share[:, None] * (known[after] - known[before])[:, :3, 3]
    if len(known) > 1:
        seconds = (known_ns - known_ns[0]) * 1e-9
        turn = Slerp(seconds, Rotation.from_matrix(known[:, :3, :3]))
        found[:, :3, :3] = turn((wanted_ns - known_ns[0]) * 1e-9).as_matrix()
    return found


def _in_ego_axes(
    poses: Float64Array,
    rows: PoseRows,
    description: Description,
    camera_from_sensor: Float64Array | None,
    place: str,
) -> Float64Array:
    """Return world_from_ego of poses as a file has them."""
    said = description.poses
    if said.inverse:
        poses = np.array([invert(pose) for pose in poses])
    of = said.of or ("camera" if rows.is_camera and camera_from_sensor is not None else "ego")
    if of == "camera":
        if camera_from_sensor is None:
            raise InvalidInput(f"{place}: poses of a camera need a file calib.txt with a line Tr: beside them")
        poses = invert(camera_from_sensor) @ poses @ camera_from_sensor
    axes = said.axes or (STANDARD_AXES if of == "ego" else description.axes)
    ego_axes_from_poses = axes_matrix(axes)
    poses = ego_axes_from_poses @ poses @ invert(ego_axes_from_poses)  # also the world's: it is written in the same
    poses[:, :3, 3] *= METRES[said.units]
    return poses if of == "ego" else poses @ invert(description.sensor.ego_from_sensor)


def require_upright(poses: SweepPoses, place: str) -> None:
    """Raise InvalidInput when the vehicle would lie on a side or climb more than it drives: axes are others."""
    known = poses.world_from_ego[np.isfinite(poses.world_from_ego).all(axis=(1, 2))]
    x_m, y_m, climb_m = known[-1, :3, 3] - known[0, :3, 3]
    way_m = float(np.hypot(x_m, y_m))
    climbs = abs(climb_m) > max(MIN_CLIMB_M, MAX_SLOPE * way_m)
    if climbs or np.median(known[:, 2, 2]) < MIN_UPRIGHT:
        what = f"climb {climb_m:.1f} m on a way of {way_m:.1f} m" if climbs else "lie on a side"
        raise InvalidInput(
            f"{place}: the vehicle would {what}: poses of a camera (say `poses: {{of: camera}}`, with calib.txt "
            "beside), or other `axes`?"
        )
