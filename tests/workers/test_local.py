"""Labelling on a Ray of our own: the same shards, whoever dies."""

import pytest

from labeling.readers.reader import open_segment
from labeling.shards.storage import open_storage
from workers.local import label_readers

pytestmark = pytest.mark.ray


@pytest.fixture
def label(cluster, config, tmp_path):
    """Return a function that labels streets on the session's Ray and returns entries by segment id."""

    def run(*uris, on_progress=lambda _: None, **options):
        readers = [open_segment("synthetic", uri) for uri in uris]
        entries = label_readers(2, readers, open_storage(tmp_path / "out"), config, on_progress, **options)
        return {entry.segment_id: entry for entry in entries}

    return run


def test_two_segments_at_once_give_the_shards_of_one_process(label, streets, shards, oracle, tmp_path):
    steps = []
    entries = label(*streets, on_progress=steps.append)
    assert {entry.state for entry in entries.values()} == {"SUCCEEDED"}
    assert shards(tmp_path / "out") == oracle
    for segment_id in entries:
        done = [step.sweeps_done for step in steps if step.segment_id == segment_id and step.stage == "sweeps"]
        assert done == list(range(len(done)))  # each sweep was told once
    assert label(*streets) == entries  # published shards are not made again
