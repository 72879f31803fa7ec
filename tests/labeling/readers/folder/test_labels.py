"""A folder is labelled like any other segment, and read from a bucket as from a disk."""

import dataclasses
import json

import numpy as np
import pytest

from labeling.folders.folder import LabelFolder
from labeling.geometry.boxes import iou_3d, transform_boxes
from labeling.readers.reader import open_segment
from labeling.storage.storage import open_storage
from service.cli import main

BOX = ("center_x_m", "center_y_m", "center_z_m", "length_m", "width_m", "height_m", "yaw_rad")


def boxes_world(street, index):
    annotations = street.read_annotations(index)
    boxes = transform_boxes(street.world_from_ego(index), annotations.boxes_ego)
    return dict(zip(annotations.track_ids, boxes, strict=True))


def best_overlaps(labels, street, index):
    """The overlap of each mover of the truth with the label that fits it best, in one sweep; -1 for what stands."""
    boxes = boxes_world(street, index)
    there = boxes_world(street, index - 1)
    is_here = labels["sweep_index"] == index
    ours = np.stack([labels[name][is_here] for name in BOX], axis=1)
    has_moved = [np.hypot(*(box[:2] - there[name][:2])) > 0.2 for name, box in boxes.items()]
    overlap = iou_3d(np.array(list(boxes.values())), ours).max(axis=1, initial=0.0)
    return np.where(has_moved, overlap, -1.0)


def test_a_folder_is_labelled_from_its_files_alone(write_folder, street, tmp_path, capsys):
    """As a user goes about it: propose a description, add what no file tells, label. Some rays met nothing."""
    rng = np.random.default_rng(0)

    def with_lost_rays(sweep):
        points = np.array(sweep.points_ego)
        points[rng.random(len(points)) < 0.05] = np.nan
        return points

    folder = write_folder(tmp_path / "drive", "pcd-compressed", points_of=with_lost_rays)
    (folder / "motionlabel.yaml").unlink()
    assert main(["init-folder", str(folder)]) == 0
    with (folder / "motionlabel.yaml").open("a") as file:
        file.write(f"origins: {json.dumps(street.read_sweep(0).sensor_origins_ego.tolist())}\n")
    output = tmp_path / "out"
    assert main(["label", str(folder), "--dataset", "folder", "--output", str(output), "--profile", "fast"]) == 0
    assert "8 sweeps (0 rejected)" in capsys.readouterr().out
    labelled = LabelFolder.open(str(output))
    (segment_id,) = labelled.segment_ids
    table = labelled.table("labels", segment_id)
    labels = {name: table[name].to_numpy() for name in ("sweep_index", *BOX)}
    assert max(best_overlaps(labels, street, index).max() for index in (2, 4, 6)) >= 0.7


def test_what_init_folder_will_not_do_is_one_line(write_folder, tmp_path, capsys):
    folder = write_folder(tmp_path / "drive")
    assert main(["init-folder", str(folder)]) == 2
    assert "is there already: --force" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["init-folder", str(tmp_path / "empty")]) == 2
    assert main(["init-folder", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.splitlines() == [
        f"motionlabel: {tmp_path}/empty: no sweeps, here or one folder below",
        f"motionlabel: {tmp_path}/none: no such folder",
    ]


@pytest.mark.parametrize("kind", ["bin", "pcd-compressed", "npz"])
def test_a_bucket_is_read_as_a_disk(kind, write_folder, bucket, tmp_path):
    folder = write_folder(tmp_path / "drive", kind)
    storage = open_storage(f"{bucket}/drives")
    for path in folder.rglob("*"):
        if path.is_file():
            storage.publish(str(path.relative_to(tmp_path)), path)
    local, remote = open_segment("folder", str(folder)), open_segment("folder", f"{bucket}/drives/drive")
    assert remote.listing.digest == local.listing.digest
    ours, theirs = remote.read_sweep(5), local.read_sweep(5)
    for field in dataclasses.fields(ours):
        np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name))


@pytest.mark.parametrize("name", ["motionlabel.yaml", "trajectory.txt"])
def test_what_is_said_and_poses_are_part_of_what_a_folder_is(name, write_folder, tmp_path):
    folder = write_folder(tmp_path / "drive")
    before = open_segment("folder", str(folder)).listing.digest
    with (folder / name).open("a") as file:
        file.write("# more\n")
    assert open_segment("folder", str(folder)).listing.digest != before
