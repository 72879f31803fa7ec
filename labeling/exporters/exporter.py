"""The protocol every format stands behind, and the lookup by name."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from schemas.errors import InvalidInput

if TYPE_CHECKING:
    from labeling.exporters.output import ExportFolder
    from labeling.exporters.segments import SegmentLabels
    from labeling.folders.folder import LabelFolder


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """What a user may choose; None: the default. Each format takes some of these, and the others are refused."""

    min_score: float | None = None  # leave out boxes below; by default what the label folder recommends
    category: str | None = None  # of all boxes; by default it follows from their sizes
    calibration: str | None = None  # KITTI calibration, a file or the folder of a date
    voxel_m: float | None = None  # edge of the voxels of a map, each of which has one point
    cloud: str | None = None  # file format of a map


class Format(NamedTuple):
    """Who writes a format, and what may be chosen."""

    module: str
    content: str  # for people
    options: tuple[str, ...]  # fields of ExportOptions
    extra: str = ""  # what to install for it


class Exporter(Protocol):
    """What the module of a format has: one function ``export``."""

    def __call__(self, segments: "Iterable[SegmentLabels]", output: "ExportFolder", options: ExportOptions) -> None:
        """Write the labels of some segments; the same labels and options give the same bytes.

        Args:
            segments: In order of their ids, read one by one as they are asked for; gone through once.
            output: Takes finished files.
            options: Only those that the format takes are set.

        Raises:
            InvalidInput: An option that does not fit, or labels or a recording that the format cannot do without.
            ShardConflict: A file is there already, with other content.
            StorageTrouble: Disk or network refused.

        """
        ...


_BOXES: Final = ("min_score", "category")
EXPORTERS: Final[Mapping[str, Format]] = {
    "av2": Format("labeling.exporters.argoverse2", "Argoverse 2 annotations.feather", _BOXES),
    "kitti": Format("labeling.exporters.kitti", "KITTI tracking label_02", (*_BOXES, "calibration")),
    "map": Format(
        "labeling.exporters.static_map", "what stands, as one point cloud, .ply or .pcd", ("voxel_m", "cloud")
    ),
    "mcap": Format("labeling.exporters.mcap", "Foxglove's messages in MCAP", _BOXES, extra="mcap"),
    "nuscenes": Format("labeling.exporters.nuscenes", "nuScenes detection and tracking results", _BOXES),
    "openlabel": Format("labeling.exporters.openlabel", "ASAM OpenLABEL 1.0", _BOXES),
    "semantickitti": Format("labeling.exporters.semantickitti", "SemanticKITTI moving points, .label", ("min_score",)),
    "wod": Format("labeling.exporters.waymo", "Waymo Open Dataset v2 lidar_box", _BOXES),
}


@dataclass(frozen=True, slots=True)
class ExportSummary:
    """What an export came to."""

    num_segments: int
    num_sweeps: int  # usable ones
    num_rejected_sweeps: int  # they have no labels
    num_boxes: int  # of the score asked for
    num_written: int  # files
    num_kept: int  # files that were there already, with the same content
    segments_without_labels: tuple[str, ...]  # those that failed


def export_labels(
    folder: "LabelFolder",
    format_name: str,
    output: str | Path,
    options: ExportOptions | None = None,
    *,
    on_segment: Callable[[int], None] = lambda num_done: None,
) -> ExportSummary:
    """Write all labels of a folder in another format, a segment at a time.

    Doing it again writes nothing; a file that holds something else is never replaced.

    Args:
        folder: The labels.
        format_name: A name of ``EXPORTERS``.
        output: A local folder or ``s3://`` prefix.
        options: See ``ExportOptions``.
        on_segment: Called with the number of segments that are done, before each and at the end.

    Raises:
        InvalidInput: Unknown format, an option that it does not take, or as ``Exporter``.
        ShardConflict: As ``Exporter``.
        StorageTrouble: As ``Exporter``.

    """
    from labeling.exporters.output import ExportFolder
    from labeling.exporters.segments import read_segment

    chosen = options or ExportOptions()
    require_options(format_name, chosen)
    require_labels(folder)
    known = EXPORTERS[format_name]
    min_score = folder.recommended_min_score if chosen.min_score is None else chosen.min_score
    if "min_score" not in known.options:
        min_score = 0.0
    export = _load(format_name)
    target = ExportFolder(output)
    num_sweeps = num_boxes = 0

    def read() -> "Iterator[SegmentLabels]":
        nonlocal num_sweeps, num_boxes
        for number, segment_id in enumerate(folder.segment_ids):
            on_segment(number)
            segment = read_segment(folder, segment_id, min_score)
            num_sweeps += len(segment.sweeps)
            num_boxes += len(segment.rows)
            yield segment

    export(read(), target, chosen)
    on_segment(len(folder.entries))
    return ExportSummary(
        num_segments=len(folder.entries),
        num_sweeps=num_sweeps,
        num_rejected_sweeps=sum(entry.num_rejected_sweeps for entry in folder.entries.values()),
        num_boxes=num_boxes,
        num_written=target.num_written,
        num_kept=target.num_kept,
        segments_without_labels=folder.segments_without_labels,
    )


def require_labels(folder: "LabelFolder") -> None:
    """Raise InvalidInput when no segment of the folder has labels."""
    if not folder.entries:
        raise InvalidInput(
            f"{folder.storage.root} holds no labels to export: all its {len(folder.segments_without_labels)} segments "
            "failed"
        )


def _load(format_name: str) -> Exporter:
    known = EXPORTERS[format_name]
    try:
        export: Exporter = import_module(known.module).export
    except ImportError as error:
        if not known.extra:
            raise
        raise InvalidInput(
            f"format {format_name} needs an extra ({error}): pip install 'motionlabel[{known.extra}]'"
        ) from None
    return export


def require_options(format_name: str, options: ExportOptions) -> None:
    """Raise InvalidInput when there is no such format, or when it has no use for an option that is set."""
    if format_name not in EXPORTERS:
        raise InvalidInput(f"unknown format {format_name!r}: expected one of {', '.join(EXPORTERS)}")
    if options.min_score is not None and not 0 <= options.min_score <= 1:
        raise InvalidInput(f"--min-score {options.min_score:g}: expected a score between 0 and 1")
    for field in fields(options):
        if getattr(options, field.name) is not None and field.name not in EXPORTERS[format_name].options:
            takers = ", ".join(name for name, known in EXPORTERS.items() if field.name in known.options)
            name = field.name.replace("_", "-")
            raise InvalidInput(f"--{name} means nothing to format {format_name}: it is an option of {takers}")
