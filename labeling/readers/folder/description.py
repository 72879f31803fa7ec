"""How a folder is to be read: ``motionlabel.yaml`` in it. Each line may be left out; what then holds stands here."""

from typing import Annotated, Final, Literal, Self

import numpy as np
import yaml
from pydantic import AfterValidator, Field, ValidationError, model_validator
from scipy.spatial.transform import Rotation

from labeling.storage.storage import Storage
from schemas.arrays import Float64Array
from schemas.config.base import Params
from schemas.errors import InvalidInput, shorten

DESCRIPTION: Final = "motionlabel.yaml"
DEFAULT_COLUMNS: Final = ("x", "y", "z", "intensity")
METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
NANOSECONDS: Final = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
DIRECTIONS: Final = {
    "forward": (1, 0, 0), "back": (-1, 0, 0), "left": (0, 1, 0),
    "right": (0, -1, 0), "up": (0, 0, 1), "down": (0, 0, -1),
}  # fmt: skip


def _below(path: str) -> str:
    if path.startswith("/") or {"", ".", ".."} & set(path.split("/")):
        raise ValueError("expected a path below the folder, without '..'")
    return path


Direction = Literal["forward", "back", "left", "right", "up", "down"]
Axes = tuple[Direction, Direction, Direction]
LengthUnit = Literal["m", "cm", "mm", "ft"]
TimeUnit = Literal["ns", "us", "ms", "s"]
Name = Annotated[str, Field(min_length=1, max_length=200)]
RelativePath = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_below)]
Metres = Annotated[float, Field(ge=-1e3, le=1e3)]
Degrees = Annotated[float, Field(ge=-360, le=360)]

STANDARD_AXES: Final[Axes] = ("forward", "left", "up")


class PointTime(Params):
    """The column that says when each point was captured."""

    column: Name
    unit: TimeUnit = "s"
    since: Literal["stamp", "epoch"] = "stamp"  # of the sweep, or as the sweeps' time stamps themselves


class LidarColumn(Params):
    """The column that says which lidar saw each point: its numbers, divided by ``lasers`` of each, count lidars."""

    column: Name
    lasers: Annotated[int, Field(ge=1, le=100_000)] = 1


class Placement(Params):
    """Where the frame of the points stands in the ego frame: turned by roll, pitch and yaw, then moved, metres."""

    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0
    roll_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    yaw_deg: Degrees = 0.0

    @property
    def ego_from_sensor(self) -> Float64Array:
        """(4, 4) Rz(yaw) Ry(pitch) Rx(roll), and the place."""
        transform = np.eye(4)
        angles_deg = [self.yaw_deg, self.pitch_deg, self.roll_deg]
        transform[:3, :3] = Rotation.from_euler("ZYX", angles_deg, degrees=True).as_matrix()
        transform[:3, 3] = self.x, self.y, self.z
        return transform


class Stamps(Params):
    """Where time stamps come from when not from names: one a line, or lines of a name and a time."""

    file: RelativePath | None = None
    unit: TimeUnit | None = None  # of numbers; None: told by their size


class Poses(Params):
    """Where the vehicle was."""

    file: RelativePath | None = None
    of: Literal["ego", "sensor", "camera"] | None = None  # what each places; None: a camera where calib.txt tells its
    inverse: bool = False  # each maps the world to the vehicle, not the vehicle to the world
    axes: Axes | None = None  # which way x, y and z of what they place; None: of the points for "sensor", else usual
    units: LengthUnit = "m"
    unit: TimeUnit | None = None  # of their times; None: told by their size


class Description(Params):
    """What ``motionlabel.yaml`` says."""

    sweeps: RelativePath | None = None  # as lidar/*.pcd; None: the only place with files of a known kind
    columns: Annotated[tuple[Name, ...], Field(min_length=3, max_length=64)] | None = None  # of .bin and bare .npy
    coordinates: tuple[Name, Name, Name] = ("x", "y", "z")  # columns
    units: LengthUnit = "m"
    axes: Axes = STANDARD_AXES  # which way x, y and z of the points
    sensor: Placement = Placement()
    origins: Annotated[tuple[tuple[Metres, Metres, Metres], ...], Field(min_length=1, max_length=64)] = ((0, 0, 0),)
    time: PointTime | None = None
    lidar: LidarColumn | None = None
    rate_hz: Annotated[float, Field(gt=0, le=1000)] | None = None  # of sweeps whose names only count them
    stamps: Stamps = Stamps()
    poses: Poses = Poses()

    @model_validator(mode="after")
    def _check(self) -> Self:
        for axes in (self.axes, self.poses.axes or STANDARD_AXES):
            if not np.linalg.det(axes_matrix(axes)):
                raise ValueError(f"axes {', '.join(axes)}: expected forward or back, left or right, up or down")
        lacking = set(self.wanted) - set(self.columns or self.wanted)
        if lacking:
            raise ValueError(f"columns: no {', '.join(sorted(lacking))} among {', '.join(self.columns or ())}")
        return self

    @property
    def wanted(self) -> tuple[str, ...]:
        """The columns that are read of each sweep."""
        extra = [column.column for column in (self.time, self.lidar) if column is not None]
        return tuple(dict.fromkeys([*self.coordinates, *extra]))

    @property
    def ego_from_points(self) -> Float64Array:
        """(4, 4) from the coordinates of a file, in its units and axes, to the ego frame. Mirrors where axes do."""
        return self.sensor.ego_from_sensor @ axes_matrix(self.axes) @ np.diag([*[METRES[self.units]] * 3, 1.0])


def axes_matrix(axes: Axes) -> Float64Array:
    """Return (4, 4) from coordinates with such axes to forward, left, up; determinant -1 for left-handed ones."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([DIRECTIONS[name] for name in axes], dtype=np.float64).T
    return matrix


def read_description(storage: Storage) -> Description:
    """Return what the YAML of a folder says; all by default where there is none.

    Raises:
        InvalidInput: It is no YAML, or a line of it is not what it has to be.

    """
    try:
        content = storage.read(DESCRIPTION)
    except FileNotFoundError:
        return Description()
    return parse_description(content, storage.place(DESCRIPTION))


def parse_description(content: bytes | str, place: str) -> Description:
    """Return what the text of a YAML says; raise InvalidInput, which begins with the place."""
    try:
        values = yaml.safe_load(content)
    except RecursionError:
        raise InvalidInput(f"{place}: not YAML of a kind: nested too deep") from None
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{place}: line {mark.line + 1}" if mark else place
        raise InvalidInput(f"{where}: not YAML: {shorten(getattr(error, 'problem', None) or str(error))}") from None
    if not isinstance(values, dict | None):
        raise InvalidInput(f"{place}: expected lines as `units: m`")
    try:
        return Description.model_validate(values or {})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        known = f"; known are {', '.join(Description.model_fields)}" if first["type"] == "extra_forbidden" else ""
        message = f"{key}: {first['msg']}" if key else first["msg"].removeprefix("Value error, ")
        raise InvalidInput(f"{place}: {shorten(message)}{known}") from None
