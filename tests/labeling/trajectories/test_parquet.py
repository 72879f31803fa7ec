import numpy as np
import pyarrow.parquet as pq
import pytest

from labeling.trajectories.trajectories import write_trajectories
from labeling.trajectories.windows import Horizon, cut_windows
from schemas.errors import InvalidInput, ShardConflict

START_NS = 1_700_000_000_000_000_000
TIMES_S = np.arange(31) / 10


@pytest.fixture
def read(tmp_path):
    """Return a function that writes the trajectories of a folder of one segment and reads their table."""

    def run(folder, output="trajectories", horizon=None, **options):
        summary = write_trajectories(folder, tmp_path / output, horizon, **options)
        (path,) = (tmp_path / output).iterdir()
        assert path.name == f"{folder.segment_ids[0]}.parquet"
        return summary, pq.read_table(path)

    return run


def steps(table, name):
    """Return (A, T) of a column of lists."""
    return table[name].combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(len(table), -1)


def test_what_is_written_are_the_windows(read, make_folder, circling):
    rows = circling(TIMES_S)
    summary, table = read(make_folder([rows]))
    windows = cut_windows(rows, START_NS, Horizon(), max_gap_s=0.55)
    assert (summary.num_tracks, summary.num_units, summary.num_gaps, summary.num_written) == (1, len(windows), 0, 1)
    np.testing.assert_array_equal(steps(table, "is_valid"), windows.is_valid)
    np.testing.assert_array_equal(steps(table, "is_observed"), windows.is_observed)
    for axis, letter in enumerate("xyz"):
        np.testing.assert_allclose(steps(table, f"center_{letter}_m"), windows.center_m[..., axis], atol=2e-6)
        np.testing.assert_allclose(steps(table, f"velocity_{letter}_mps"), windows.velocity_mps[..., axis], atol=1e-5)
        np.testing.assert_allclose(table[f"anchor_center_{letter}_m"], windows.anchor_center_m[:, axis], atol=1e-9)
    np.testing.assert_allclose(steps(table, "yaw_rad"), windows.yaw_rad, atol=1e-6)
    np.testing.assert_allclose(table["anchor_yaw_rad"], windows.anchor_yaw_rad, atol=1e-12)
    np.testing.assert_allclose(steps(table, "score"), windows.score, atol=1e-7)
    assert table["anchor_timestamp_ns"].to_pylist() == windows.anchor_timestamp_ns.tolist()
    assert table["num_valid_history"].to_pylist() == [0, 5, 10, 10, 10, 10, 10]
    assert table["num_valid_future"].to_pylist() == [30, 25, 20, 15, 10, 5, 0]
    assert [table[f"{side}_m"][0].as_py() for side in ("length", "width", "height")] == pytest.approx([4.5, 1.8, 1.6])


def test_the_file_says_at_which_times_its_steps_are(read, make_folder, circling):
    _, table = read(make_folder([circling(TIMES_S)]), horizon=Horizon(hz=5, history_s=2, future_s=4))
    said = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert said == {
        "motionlabel.schema_version": "1",
        "motionlabel.hz": "5",
        "motionlabel.num_history": "10",
        "motionlabel.num_future": "20",
        "motionlabel.max_gap_s": "0.55",
    }
    assert table["is_valid"].type.list_size == 31


def test_tracks_are_taken_whole_by_their_mean_score(read, make_folder, driving):
    tracks = [
        driving(TIMES_S, track_id="doubted at its end", score=np.linspace(1.0, 0.2, 31)),
        driving(TIMES_S, track_id="doubtful", score=0.4),
    ]
    folder = make_folder(tracks)
    _, table = read(folder)
    assert set(table["track_id"].to_pylist()) == {"doubted at its end"}
    assert steps(table, "is_valid").sum() == sum(range(26, 0, -5)) + 31 + sum((5, 10, 10, 10, 10, 10))
    assert set(read(folder, "all", min_score=0.3)[1]["track_id"].to_pylist()) == {"doubted at its end", "doubtful"}


def test_gaps_are_counted_and_the_silence_is_the_users(read, make_folder, driving):
    folder = make_folder([driving([time_s for time_s in TIMES_S if not 1.05 < time_s < 1.95])])
    summary, table = read(folder)
    assert (summary.num_gaps, len(table)) == (1, 6)
    summary, table = read(folder, "bridged", max_gap_s=1.0)
    assert (summary.num_gaps, len(table)) == (0, 7)


def test_where_sweeps_are_rare_the_next_one_is_reached(read, make_folder, make_sweep, driving):
    sweeps = [make_sweep(index) for index in range(0, 31, 7)]  # 0.7 s apart
    folder = make_folder([driving(np.arange(0, 31, 7) / 10)], sweeps=sweeps)
    assert steps(read(folder)[1], "is_valid")[0, 10:39].all()


def test_writing_again_writes_nothing_and_replaces_nothing(read, make_folder, circling, tmp_path):
    folder = make_folder([circling(TIMES_S)])
    read(folder)
    (path,) = (tmp_path / "trajectories").iterdir()
    before = path.read_bytes()
    summary, _ = read(folder)
    assert (summary.num_written, summary.num_kept) == (0, 1)
    with pytest.raises(ShardConflict, match="is there with other content"):
        read(folder, horizon=Horizon(hz=20))
    assert path.read_bytes() == before


def test_the_same_labels_give_the_same_bytes(read, make_folder, circling, driving, tmp_path, contents):
    tracks = [circling(TIMES_S), driving(TIMES_S, track_id="other")]
    read(make_folder(tracks), "one")
    read(make_folder(tracks[::-1], name="again"), "two")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_a_segment_without_tracks_has_an_empty_table(read, make_folder):
    summary, table = read(make_folder([]))
    assert (summary.num_tracks, summary.num_units, len(table)) == (0, 0, 0)
    assert table["is_valid"].type.list_size == 91


def test_a_track_is_written_at_a_time(read, make_folder, circling, tmp_path):
    """Memory is that of one track's windows: a row group each."""
    names = [f"car {number}" for number in range(5)]
    read(make_folder([circling(TIMES_S, track_id=name) for name in names]))
    (path,) = (tmp_path / "trajectories").iterdir()
    file = pq.ParquetFile(path)
    assert [set(file.read_row_group(number)["track_id"].to_pylist()) for number in range(file.num_row_groups)] == [
        {name} for name in names
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_gap_s": -1.0}, "--max-gap-s -1: expected 0 to 60"),
        ({"min_score": 1.5}, "--min-score 1.5: expected a score between 0 and 1"),
        ({"format_name": "csv"}, "unknown format 'csv': expected one of parquet, scenarionet"),
    ],
)
def test_bad_values_are_refused(make_folder, tmp_path, options, message):
    with pytest.raises(InvalidInput, match=message):
        write_trajectories(make_folder([]), tmp_path / "x", **options)
