"""What all formats have in common."""

import re

import pytest

from labeling.exporters.exporter import EXPORTERS, ExportOptions, ExportSummary, export_labels, require_options
from labeling.folders.folder import LabelFolder
from schemas.errors import InvalidInput, ShardConflict

KITTI_CALIBRATION = (
    "P2: 700 0 600 0 0 700 170 0 0 0 1 0\nR_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
)


@pytest.fixture
def options_of(tmp_path):
    """Return a function that gives the options that a format cannot do without."""
    calibration = tmp_path / "calib.txt"
    calibration.write_text(KITTI_CALIBRATION)
    return lambda format_name: {"calibration": str(calibration)} if format_name == "kitti" else {}


@pytest.mark.parametrize("format_name", EXPORTERS)
def test_a_second_export_writes_nothing(label_recorded, export, contents, options_of, format_name, tmp_path):
    labels = label_recorded()
    folder = export(labels, format_name, **options_of(format_name))
    before = contents(folder)
    assert before
    stamps = {name: (folder / name).stat().st_mtime_ns for name in before}
    summary = export_labels(labels, format_name, folder, ExportOptions(**options_of(format_name)))
    assert (summary.num_written, summary.num_kept) == (0, len(before))
    assert contents(folder) == before
    assert {name: (folder / name).stat().st_mtime_ns for name in before} == stamps
    assert contents(export(labels, format_name, "elsewhere", **options_of(format_name))) == before


@pytest.mark.parametrize("format_name", EXPORTERS)
def test_other_labels_under_the_same_name_are_refused(label_recorded, export, contents, options_of, format_name):
    folder = export(label_recorded(), format_name, **options_of(format_name))
    before = contents(folder)
    others = label_recorded("others", moving=(8, 9, 10), box_ego=[22.0, -4.0, 1.0, 4.5, 1.8, 1.6, 0.5])
    with pytest.raises(ShardConflict, match=r"export/.* is there with other content, .*: delete it, or choose another"):
        export(others, format_name, **options_of(format_name))
    assert contents(folder) == before


@pytest.mark.parametrize("format_name", EXPORTERS)
def test_an_interrupted_export_goes_on(label_recorded, export, contents, options_of, format_name):
    labels = label_recorded()
    folder = export(labels, format_name, **options_of(format_name))
    whole = contents(folder)
    (folder / next(iter(whole))).unlink()
    assert contents(export(labels, format_name, **options_of(format_name))) == whole


def test_boxes_below_the_cut_are_left_out(labels, make_labels, make_driven, tmp_path):
    def num_boxes(**options):
        return export_labels(labels, "av2", tmp_path / f"{len(options)}{options}", ExportOptions(**options)).num_boxes

    assert num_boxes() == num_boxes(min_score=0.5) == 4
    assert num_boxes(min_score=0.2) == 5
    assert num_boxes(min_score=0.7) == 3
    assert num_boxes(min_score=1.0) == 0


def test_the_summary_counts_and_names_segments_that_failed(make_labels, make_driven, tmp_path):
    folder = make_labels([make_driven()], failed=["lost-1"])
    done = export_labels(folder, "av2", tmp_path / "export")
    assert done == ExportSummary(
        num_segments=1,
        num_sweeps=3,
        num_rejected_sweeps=0,
        num_boxes=3,
        num_written=1,
        num_kept=0,
        segments_without_labels=("lost-1",),
    )


def test_segments_come_one_by_one(make_labels, make_driven, tmp_path):
    for uri in ("/data/b", "/data/a"):
        folder = make_labels([make_driven()], uri=uri)
    steps = []
    assert export_labels(folder, "av2", tmp_path / "export", on_segment=steps.append).num_segments == 2
    assert steps == [0, 1, 2]
    assert sorted(path.name for path in (tmp_path / "export").iterdir()) == list(folder.segment_ids)


@pytest.mark.parametrize(
    ("format_name", "options", "message"),
    [
        ("csv", {}, rf"unknown format 'csv': expected one of {', '.join(EXPORTERS)}"),
        ("av2", {"min_score": 1.5}, r"--min-score 1.5: expected a score between 0 and 1"),
        ("av2", {"min_score": float("nan")}, r"--min-score nan: expected a score between 0 and 1"),
        ("av2", {"calibration": "x"}, r"--calibration means nothing to format av2: it is an option of kitti$"),
        ("av2", {"category": "CAR"}, r"--category CAR: expected one of ANIMAL, .*, WHEELED_RIDER"),
        ("kitti", {}, r"format kitti has boxes in the frame of a camera: give .* --calibration"),
        ("kitti", {"calibration": "/nowhere"}, r"--calibration /nowhere: no such file or folder"),
    ],
)
def test_wrong_options_are_one_line(labels, export, format_name, options, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        export(labels, format_name, **options)
    assert "\n" not in str(caught.value)


def test_options_are_known_to_some_format():
    named = {name for known in EXPORTERS.values() for name in known.options}
    assert named == set(ExportOptions.__dataclass_fields__)
    for format_name in EXPORTERS:
        require_options(format_name, ExportOptions())


def test_no_labels_are_one_line(tmp_path):
    with pytest.raises(InvalidInput, match=r"no labels at .*nowhere: expected manifests"):
        LabelFolder.open(tmp_path / "nowhere")


def test_a_folder_whose_segments_all_failed_is_one_line(make_labels, make_driven, tmp_path):
    folder = make_labels([make_driven()], failed=["lost-1", "lost-2"])
    empty = LabelFolder(folder.storage, folder.manifests, {})
    with pytest.raises(InvalidInput, match=r"holds no labels to export: all its 3 segments failed"):
        export_labels(empty, "av2", tmp_path / "export")


def test_boxes_of_a_rejected_sweep_are_one_line(make_labels, make_sweep, make_driven, export):
    sweeps = [make_sweep(0), make_sweep(1, reason="truncated"), make_sweep(2)]
    folder = make_labels([make_driven()], sweeps=sweeps)
    with pytest.raises(InvalidInput, match=r"boxes in sweep 1, which has no usable row in its table of sweeps"):
        export(folder, "av2")


def test_a_file_in_the_way_is_one_line(labels, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InvalidInput, match=re.escape(str(tmp_path / "file"))):
        export_labels(labels, "av2", tmp_path / "file")


def test_a_bucket_is_written_as_a_disk_is(labels, export, contents, bucket):
    from labeling.storage.storage import open_storage

    there = contents(export(labels, "av2"))
    first = export_labels(labels, "av2", f"{bucket}/labels")
    second = export_labels(labels, "av2", f"{bucket}/labels")
    assert (first.num_written, second.num_written, second.num_kept) == (1, 0, 1)
    storage = open_storage(f"{bucket}/labels")
    assert {name: storage.read(name) for name in there} == there
    with pytest.raises(ShardConflict):
        export_labels(labels, "av2", f"{bucket}/labels", ExportOptions(min_score=0.1))
