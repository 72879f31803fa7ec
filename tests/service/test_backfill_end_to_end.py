"""From logs in a bucket to labels in the bucket: the real service, its Ray and `backfill`, against an S3 server."""

import sys

import pytest

from labeling.folders.folder import LabelFolder
from labeling.in_process import label_in_process
from labeling.readers.reader import segment_id_of
from labeling.run import label_segments
from labeling.storage.storage import open_storage
from schemas.backfill import BackfillSummary
from schemas.config import resolve_config
from service.local_service import local_service

pytestmark = [pytest.mark.ray, pytest.mark.timeout(600), pytest.mark.usefixtures("default_signals")]

CHEAP = {"static.vote_gaps_s": [0.1, 0.2], "flow.iterations": 3}


@pytest.fixture
def drives(bucket, write_log):
    """Three logs of six sweeps in the bucket, one of them without poses."""
    place = f"{bucket}/drives"
    for name in ("a/log1", "b/log2", "b/broken"):
        folder, storage = write_log(name), open_storage(f"{place}/{name}")
        for path in folder.rglob("*.feather"):
            if not (name == "b/broken" and path.name.startswith("city")):
                storage.publish(path.relative_to(folder).as_posix(), path)
    return place


def test_a_bucket_is_labelled_and_its_labels_are_those_of_one_process(cli, bucket, drives, tmp_path, monkeypatch):
    (tmp_path / "serve").mkdir()
    output = f"{bucket}/labels"
    options = [f"--set={key}={value}" for key, value in CHEAP.items()]
    arguments = ("backfill", drives, "--dataset", "av2", "--output", output, "--profile", "fast", *options)
    may_use_it = ("env", f"MOTIONLABEL_DATA_ROOTS={bucket}", sys.executable, "-P", "-m", "service", "serve", "--port=0")
    with local_service(tmp_path / "serve", may_use_it) as url:
        monkeypatch.setenv("MOTIONLABEL_SERVER", url)
        code, out, err = cli(*arguments, "--batch-size", "2", "--json", tmp_path / "summary.json")
        assert (code, len(err)) == (3, 1)
        assert "see `motionlabel status " in err[0]
        assert out.startswith(f"{output}: 2 of 3 segments labelled, in 2 jobs, 1 FAILED\n")
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert summary.is_complete
    assert summary.core_hours > 0

    good = [f"{drives}/a/log1", f"{drives}/b/log2"]
    label_segments("av2", good, f"{bucket}/oracle", resolve_config("fast", CHEAP), label_in_process)
    ours, oracle = open_storage(output), open_storage(f"{bucket}/oracle")
    for table in ("labels", "sweeps"):
        paths = [path.rpartition("/")[2] for path in ours.list_files(table)]
        assert len(paths) == 2
        for name in paths:
            assert ours.read(f"{table}/{name}") == oracle.read(f"{table}/{name}")
    folder = LabelFolder.open(output)
    assert set(folder.segment_ids) == {segment_id_of("av2", uri) for uri in good}
    assert all(len(folder.table("labels", segment_id)) for segment_id in folder.segment_ids)
