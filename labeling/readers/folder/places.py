"""Which files of a folder are what."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import groupby
from typing import Final

from labeling.readers.files import likely_cause
from labeling.readers.folder.columns import FORMATS, format_of
from labeling.readers.folder.description import DESCRIPTION, Description
from labeling.readers.folder.stamps import in_order
from labeling.storage.storage import Storage
from schemas.errors import InvalidInput

POSES: Final = tuple(
    f"{name}.{suffix}"
    for name in ("poses", "pose", "trajectory", "odometry", "odom", "tum", "lidar_poses", "gt_poses", "groundtruth")
    for suffix in ("txt", "csv", "npy", "tum")
)
STAMPS: Final = tuple(f"{name}.{suffix}" for name in ("timestamps", "times", "stamps") for suffix in ("txt", "csv"))
CALIBRATION: Final = "calib.txt"
_NO_SWEEPS: Final = {*POSES, "annotations.feather", "flow_labels.feather", "city_SE3_egovehicle.feather"}
_SWEEP_FOLDERS: Final = 50  # that are looked into


@dataclass(frozen=True, slots=True)
class CommonFiles:
    """What every sweep needs; None where there is none."""

    poses: str | None
    stamps: str | None
    calibration: str | None

    @property
    def names(self) -> tuple[str, ...]:
        """All of them, and the YAML, which is also one where it is not there."""
        return (DESCRIPTION, *(name for name in (self.poses, self.stamps, self.calibration) if name))


def find_common(description: Description, names: Iterable[str], place: str, *, needs_poses: bool = True) -> CommonFiles:
    """Return which of the files that there are hold poses, time stamps and a camera's calibration.

    Raises:
        InvalidInput: There are no poses, several that may be them, or one that the YAML names is missing.

    """
    there = set(names)
    poses = _chosen(description.poses.file, "poses", POSES, there, place)
    if poses is None and needs_poses:
        raise InvalidInput(
            f"{place}: no poses: labelling needs to know where the vehicle was. Looked for poses.txt, poses.csv, "
            "poses.npy, and the same as pose, trajectory, odometry, odom, tum, lidar_poses, gt_poses, groundtruth; "
            f"name another in {DESCRIPTION}, as `poses: {{file: slam/path.txt}}`"
        )
    stamps = _chosen(description.stamps.file, "stamps", STAMPS, there, place)
    return CommonFiles(poses, stamps, CALIBRATION if CALIBRATION in there else None)


def _chosen(said: str | None, key: str, usual: Sequence[str], there: set[str], place: str) -> str | None:
    if said is not None:
        if said not in there:
            raise InvalidInput(f"{place}/{said}: no such file, which {DESCRIPTION} names as `{key}: {{file: ...}}`")
        return said
    found = [name for name in usual if name in there]
    if len(found) > 1:
        raise InvalidInput(
            f"{place}: {' and '.join(found)}: say which in {DESCRIPTION}, as `{key}: {{file: {found[0]}}}`"
        )
    return found[0] if found else None


def common_names(storage: Storage, description: Description) -> list[str]:
    """Return the files that may hold what every sweep needs: those beside the YAML, and those that it names."""
    said = [name for name in (description.poses.file, description.stamps.file) if name]
    return [*storage.list_files(), *(name for name in said if "/" in name and storage.size(name) is not None)]


def find_sweeps(storage: Storage, description: Description) -> list[str]:
    """Return the sweeps of a folder, in the order of their names.

    Raises:
        InvalidInput: There are none, or several folders or formats that may be them.

    """
    if description.sweeps is not None:
        folder, _, pattern = description.sweeps.rpartition("/")
        names = [name for name in storage.list_files(folder) if fnmatchcase(name.rpartition("/")[2], pattern)]
        odd = next((name for name in names if format_of(name) is None), None)
        if odd is not None:
            raise InvalidInput(f"{storage.place(odd)}: of no known format, but `sweeps: {description.sweeps}` names it")
        if not names:
            raise InvalidInput(f"{storage.place(folder)}: no file as `sweeps: {description.sweeps}` says")
        return in_order(names)
    kinds = sweep_places(storage)
    if not kinds:
        expected = f"expected files .{', .'.join(FORMATS)}, here or one folder below"
        raise InvalidInput(f"{storage.root}: no sweeps: {expected}{likely_cause(storage)}")
    if len(kinds) > 1:
        found = " and ".join(kinds)
        raise InvalidInput(
            f"{storage.root}: sweeps may be {found}: say which in {DESCRIPTION}, as `sweeps: {next(iter(kinds))}`"
        )
    return next(iter(kinds.values()))


def sweep_places(storage: Storage) -> dict[str, list[str]]:
    """Return, for each pattern that names files of a known format here or one folder below, these in order."""
    found: dict[str, list[str]] = {}
    folders = ["", *sorted(storage.list_folders())[:_SWEEP_FOLDERS]]
    for folder in folders:
        names = [name for name in storage.list_files(folder) if format_of(name) and name not in _NO_SWEEPS]
        for kind, group in groupby(sorted(names, key=lambda name: format_of(name) or ""), key=format_of):
            found[f"{folder}/*.{kind}".lstrip("/")] = in_order(list(group))
    return found
