"""`motionlabel label`: what it writes, what it says and the code it ends with, with trivial stages in between."""

import os
import re
import shutil
import signal
import tempfile
import time
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest

import labeling.in_process
from labeling.folders.folder import LabelFolder
from labeling.folders.identity import LABEL_VERSION, code_version
from labeling.storage.local import LocalStorage
from schemas.errors import StageFailed, StorageTrouble

pytestmark = pytest.mark.usefixtures("fast_stages")


def files(folder):
    return {path: path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def test_a_good_segment_is_labelled_and_summed_up(write_log, label, tmp_path):
    code, out, err = label(write_log(), "--points", "--in-process")
    assert (code, err) == (0, [])
    summary, cost = out.splitlines()
    assert summary == f"{tmp_path / 'out'}: 1 of 1 segment labelled, 6 sweeps (0 rejected), 1 track, 6 label rows"
    assert cost.endswith("core-seconds a sweep")
    folder = LabelFolder.open(tmp_path / "out")
    (segment_id,) = folder.segment_ids
    assert segment_id.startswith("log-")
    assert folder.entry(segment_id).state == "SUCCEEDED"
    owners = folder.table("points", segment_id).filter(pc.field("point_index") == 100)["track_id"].unique().to_pylist()
    assert owners == [f"track of {segment_id}"]


def test_labelling_again_changes_nothing(write_log, label, tmp_path):
    log = write_log()
    label(log)
    before = files(tmp_path / "out")
    code, out, err = label(log)
    assert (code, err) == (0, [])
    assert out.splitlines()[-1] == "1 segment was already there"
    assert files(tmp_path / "out") == before


def test_two_runs_give_the_same_bytes(write_log, label, tmp_path):
    logs = [write_log("a"), write_log("b")]
    label(*logs, output="one")
    label(*reversed(logs), output="two")
    one, two = (
        {path.relative_to(tmp_path / name): content for path, content in files(tmp_path / name).items()}
        for name in ("one", "two")
    )
    assert one == two


def test_a_bad_sweep_is_rejected_and_the_rest_is_labelled(write_log, label, damage_sweep, tmp_path):
    log = write_log()
    name = damage_sweep(log, 2)
    code, out, err = label(log)
    assert code == 3
    assert "6 sweeps (1 rejected)" in out
    assert len(err) == 1
    assert "PARTIAL: 1 of 6 sweeps rejected, the first: " in err[0]
    assert name in err[0]
    folder = LabelFolder.open(tmp_path / "out")
    assert folder.manifests[0].is_complete
    sweeps = folder.table("sweeps", folder.segment_ids[0])
    assert sweeps["status"].to_pylist() == ["ok", "ok", "rejected", "ok", "ok", "ok"]
    again = label(log)
    assert (again[0], again[2]) == (code, err)  # what is there already says the same


def test_a_segment_with_bad_sweeps_only_fails_and_can_be_mended(write_log, label, damage_sweep, tmp_path):
    log = write_log(num_sweeps=2)
    good = files(log)
    for index in range(2):
        damage_sweep(log, index)
    code, _, err = label(log)
    assert code == 1
    assert len(err) == 1
    assert "FAILED: all 2 sweeps were rejected, the first: " in err[0]
    assert LabelFolder.open(tmp_path / "out").segment_ids == ()
    for path, content in good.items():
        path.write_bytes(content)
    assert label(log)[0] == 0
    assert len(LabelFolder.open(tmp_path / "out").manifests) == 1


@pytest.mark.parametrize(
    ("num_sweeps", "times_s"), [(1, None), (4, [0, 0.1, 3.0, 3.1])], ids=["one sweep only", "a gap"]
)
def test_normal_oddities(write_log, label, num_sweeps, times_s):
    code, out, _ = label(write_log(num_sweeps=num_sweeps, times_s=times_s))
    assert code == 0
    assert f"{num_sweeps} sweep" in out


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_as_ctrl_c_does(write_log, label, monkeypatch, tmp_path, default_signals, number):
    def be_told(*_):
        os.kill(os.getpid(), number)
        time.sleep(60)

    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr("labeling.in_process.observe_sweeps", be_told)
    code, _, err = label(write_log(), "--points")
    assert code == 130
    assert err == ["motionlabel: interrupted: finished segments are kept, and the same command goes on from there"]
    assert not list((tmp_path / "temporary").iterdir())


def test_a_segment_that_cannot_be_opened_fails_alone(write_log, label, tmp_path):
    code, out, err = label(tmp_path / "missing", write_log())
    assert code == 3
    assert "1 of 2 segments labelled" in out
    assert len(err) == 1
    assert "FAILED" in err[0]
    assert f"{tmp_path / 'missing'}: no such folder" in err[0]
    write_log("missing")
    assert label(tmp_path / "missing", tmp_path / "log")[0] == 0
    assert [manifest.is_complete for manifest in LabelFolder.open(tmp_path / "out").manifests] == [True]


@pytest.fixture
def break_first(monkeypatch):
    """Return a function that makes the tracking of logs called ``a`` raise an error."""
    label_tracks = labeling.in_process.label_tracks

    def run(error):
        def break_once(proposals_of_sweeps, clock, config, segment_id):
            if segment_id.startswith("a-"):
                raise error
            return label_tracks(proposals_of_sweeps, clock, config, segment_id)

        monkeypatch.setattr("labeling.in_process.label_tracks", break_once)

    return run


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (StageFailed("tracking did not end"), "tracking did not end"),
        (ZeroDivisionError("division\nby zero"), "ZeroDivisionError: division by zero"),
    ],
)
def test_a_stage_that_breaks_fails_its_segment_alone(write_log, label, break_first, error, says):
    break_first(error)
    code, out, err = label(write_log("a"), write_log("b"))
    assert code == 3
    assert "1 of 2 segments labelled" in out
    assert len(err) == 1
    assert err[0].startswith("motionlabel: a-")
    assert err[0].endswith(f" FAILED: {says}")


@pytest.mark.parametrize("error", [MemoryError(), OSError(5, "Input/output error")])
def test_what_would_meet_all_segments_ends_the_run(write_log, label, break_first, error):
    break_first(error)
    code, out, err = label(write_log("a"), write_log("b"))
    assert (code, out) == (1, "")
    assert len(err) == 1


def test_the_trace_of_a_broken_stage_is_one_variable_away(write_log, label, break_first, monkeypatch, caplog):
    break_first(ZeroDivisionError("division by zero"))
    label(write_log("a"))
    assert "Traceback" not in caplog.text
    monkeypatch.setitem(os.environ, "MOTIONLABEL_DEBUG", "1")
    label(write_log("a"))
    assert "Traceback (most recent call last):" in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}/missing"], "{tmp}/missing: no such folder"),
        (["{tmp}/missing", "{tmp}/gone"], "{tmp}/missing: no such folder (and 1 more such segments)"),
        (["{tmp}/log/city_SE3_egovehicle.feather"], "is a file, expected the folder of one av2 segment"),
        (["{tmp}"], "no folder sensors/lidar/"),
        (["{tmp}/log", "{tmp}/log"], "{tmp}/log and {tmp}/log are one segment"),
        (["{tmp}/log", "{tmp}/link"], "{tmp}/link and {tmp}/log are one segment"),
        (["{tmp}/missing", "file://{tmp}/missing/"], "file://{tmp}/missing/ and {tmp}/missing are one segment"),
        (["{tmp}/log", "--dataset", "lyft"], "unknown dataset 'lyft': expected one of av2"),
        (["{tmp}/log", "--profile", "best"], "unknown profile 'best': expected one of default, paper, fast"),
        (["{tmp}/log", "--set", "flow.iterations"], "expected KEY=VALUE"),
        (["{tmp}/log", "--set", "flow.iteration=3"], "unknown option flow.iteration"),
        (["{tmp}/log", "--set", "flow.iterations=many"], "flow.iterations='many'"),
        (["{tmp}/log", "--set", "flow.iterations=0"], "flow.iterations=0: Input should be greater"),
        (["{tmp}/log", "--set", "write_points=true"], "use the option --points instead"),
        (["{tmp}/log", "--set", "flow.iterations=" + "[" * 3000 + "]" * 3000], "flow.iterations='[[["),
        (["{tmp}/log", "--set", "a." * 3000 + "x=1"], "unknown option a: "),
        (["{tmp}/log", "--set", "flow.learning_rate=NaN"], "flow.learning_rate='NaN': Input should be a finite number"),
        (["{tmp}/log", "--set", "flow.learning_rate=-1e999"], "'-1e999': Input should be a finite number"),
        (["{tmp}/log", "--set", "static.vote_gaps_s=[0.5, Infinity]"], "static.vote_gaps_s='[0.5, Infinity]'"),
        (["{tmp}/log", "--output", ""], "--output is empty: expected a path or s3://bucket/prefix"),
        (["{tmp}/log", "--sweeps", "0:" + 25 * "1"], "option sweeps.1="),
        (["{tmp}/log", "--sweeps", "5"], "--sweeps 5: expected START:STOP"),
        (["{tmp}/log", "--sweeps", "3:3"], "--sweeps 3:3: expected START:STOP"),
        (["{tmp}/log", "--sweeps", "0:7"], "sweeps 0:7 lie outside"),
        (["{tmp}/log", "--workers", "0"], "--workers': Input should be greater than or equal to 1"),
        (["{tmp}/log", "--workers", "2", "--in-process"], "--in-process and --workers exclude each other"),
        ([], "Missing argument"),
    ],
    ids=lambda value: "-".join(value)[-40:] if isinstance(value, list) else "",
)
def test_wrong_input_is_one_line_and_leaves_no_folder(write_log, label, tmp_path, arguments, message):
    (tmp_path / "link").symlink_to(write_log())
    code, out, err = label(*(argument.format(tmp=tmp_path) for argument in arguments))
    assert (code, out) == (2, "")
    assert len(err) == 1
    assert err[0].startswith("motionlabel: ")
    assert message.format(tmp=tmp_path) in err[0]
    assert not (tmp_path / "out").exists()


def test_overrides_and_ranges_reach_the_labels(write_log, label, tmp_path):
    code, out, _ = label(write_log(), "--sweeps", "1:4", "--profile", "paper", "--set", "flow.iterations=80")
    assert code == 0
    assert "3 sweeps" in out
    (manifest,) = LabelFolder.open(tmp_path / "out").manifests
    assert manifest.config["sweeps"] == [1, 4]
    assert manifest.config["flow"]["iterations"] == 80
    assert manifest.config["flow"]["hidden_layers"] == 8


def test_labels_from_other_settings_are_not_mixed_in(write_log, label, tmp_path, monkeypatch):
    log = write_log()
    label(log)
    before = files(tmp_path / "out")
    code, _, err = label(log, "--set", "seed=1")
    assert code == 2
    assert len(err) == 1
    assert "already holds labels of log-" in err[0]
    assert "made with other settings (seed=0, here 1)" in err[0]
    assert "choose another --output, or delete the old labels, " in err[0]
    with monkeypatch.context() as patch:
        patch.setattr("labeling.folders.identity.LABEL_VERSION", LABEL_VERSION + 1)
        code, _, err = label(log)
    assert code == 2
    assert f"made with other code (label version {LABEL_VERSION}, here {LABEL_VERSION + 1})" in err[0]
    assert files(tmp_path / "out") == before
    for path in (tmp_path / "out").glob(err[0].rpartition(f"{tmp_path / 'out'}/")[2]):
        path.unlink()
    code, out, _ = label(log, "--set", "seed=1")
    assert code == 0
    assert "1 of 1 segment labelled" in out
    folder = LabelFolder.open(tmp_path / "out")
    (segment_id,) = folder.segment_ids
    assert len(folder.table("sweeps", segment_id)) == 6  # the old manifest is still there, and is not believed


def test_labels_from_before_there_were_reservations_are_not_mixed_in(write_log, label, tmp_path):
    log = write_log()
    label(log)
    shutil.rmtree(tmp_path / "out/reservations")
    code, _, err = label(log, "--set", "seed=1")
    assert code == 2
    assert "already holds labels of log-" in err[0]
    assert "made by an older motionlabel" in err[0]
    assert "1 segment was already there" in label(log)[1]


def test_a_comment_in_the_code_makes_no_other_labels(write_log, label, tmp_path, monkeypatch):
    logs = [write_log("a"), write_log("b")]
    label(logs[0])
    with monkeypatch.context() as patch:
        for module in ("identity", "entries"):
            patch.setattr(f"labeling.folders.{module}.code_version", lambda: "0.0.0+newer")
        code, out, _ = label(*logs)
    assert code == 0
    assert "1 segment was already there" in out
    (manifest,) = [each for each in LabelFolder.open(tmp_path / "out").manifests if len(each.segments) == 2]
    assert manifest.code_version == "0.0.0+newer"
    made_by = [{shard.code_version for shard in segment.shards} for segment in manifest.segments]
    assert made_by == [{code_version()}, {"0.0.0+newer"}]
    assert {shard.label_version for segment in manifest.segments for shard in segment.shards} == {LABEL_VERSION}


@pytest.mark.parametrize(
    ("first", "second"), [([], ["--set", "seed=1"]), ([], []), ([], ["--points"])], ids=["other", "equal", "points"]
)
def test_two_runs_at_once_leave_one_set_of_labels(write_log, label, tmp_path, monkeypatch, first, second):
    """The second begins and ends while the first is at work: it has looked for other labels, and found none."""
    log = write_log()
    observe_sweeps = labeling.in_process.observe_sweeps
    outcomes = []

    def interleave(reader, config):
        monkeypatch.setattr("labeling.in_process.observe_sweeps", observe_sweeps)
        yield from observe_sweeps(reader, config)
        outcomes.append(label(log, *second))

    monkeypatch.setattr("labeling.in_process.observe_sweeps", interleave)
    outcomes.append(label(log, *first))
    is_other = "seed=1" in second
    assert [code for code, _, _ in outcomes] == [0, 1 if is_other else 0]
    assert ("made with other settings (seed=1, here 0)" in "".join(outcomes[1][2])) == is_other
    label(log, output="alone")
    rows = [len(ds.dataset(tmp_path / output / "labels").to_table()) for output in ("out", "alone")]
    assert rows[0] == rows[1] > 0


def test_an_output_that_cannot_be_written_is_found_before_labelling(write_log, label, tmp_path, monkeypatch):
    monkeypatch.setattr("labeling.in_process.observe_sweeps", lambda *_: pytest.fail("labelling began"))
    log = write_log()
    (tmp_path / "out").write_text("in the way")
    code, _, err = label(log)
    assert code == 2
    assert len(err) == 1
    assert "cannot write labels to" in err[0]

    def refuse(self, **_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "touch", refuse)  # tests may run as root, whom no mode stops
    code, _, err = label(log, output="read-only")
    assert code == 2
    assert len(err) == 1
    assert "Permission denied" in err[0]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), StorageTrouble("No space left on device")])
def test_a_full_disk_stops_the_run_and_it_can_go_on(write_log, label, tmp_path, monkeypatch, error):
    publish = LocalStorage.publish

    def fill_up(self, path, source):
        if path.startswith("sweeps/b-"):
            raise error
        return publish(self, path, source)

    logs = [write_log("a"), write_log("b")]
    with monkeypatch.context() as patch:
        patch.setattr(LocalStorage, "publish", fill_up)
        code, _, err = label(*logs)
    assert code == 1
    assert len(err) == 1
    assert err[0].startswith("motionlabel: disk or network trouble: ")
    assert err[0].endswith("No space left on device; run it again to go on")
    assert [segment_id[:2] for segment_id in LabelFolder.open(tmp_path / "out").segment_ids] == ["a-"]
    code, out, _ = label(*logs)
    assert code == 0
    assert "1 segment was already there" in out


@pytest.mark.parametrize("size", [0, 300])
@pytest.mark.parametrize("table", ["labels", "sweeps"])
@pytest.mark.parametrize("is_listed", [True, False])
def test_a_truncated_shard_is_named_with_what_to_do(write_log, label, tmp_path, table, size, is_listed):
    log = write_log()
    assert label(log)[0] == 0
    (shard,) = (tmp_path / "out" / table).iterdir()
    whole = shard.read_bytes()
    shard.write_bytes(whole[:size])
    if not is_listed:
        shutil.rmtree(tmp_path / "out/manifests")
    code, out, (line,) = label(log)
    assert (code, out) == (2, "")
    assert f"{shard} is no whole Parquet file (an incomplete copy? delete it and label again): " in line
    shard.unlink()
    assert label(log)[0] == 0
    assert shard.read_bytes() == whole


def test_a_bucket_that_does_not_exist_is_one_line(write_log, label, cli, bucket):
    for arguments in (["s3://another-bucket/log"], [write_log(), "--output", "s3://another-bucket/out"]):
        code, out, (line,) = label(*arguments)
        assert (code, out) == (2, "")
        assert re.fullmatch(r"motionlabel: s3://another-bucket/\S+: no such bucket", line)


def test_ctrl_c_keeps_finished_segments(write_log, label, tmp_path, monkeypatch):
    observe_sweeps = labeling.in_process.observe_sweeps

    def interrupt(reader, config):
        for observation in observe_sweeps(reader, config):
            if reader.segment_id.startswith("b-") and observation.sweep_index == 3:
                raise KeyboardInterrupt
            yield observation

    logs = [write_log("a"), write_log("b")]
    with monkeypatch.context() as patch:
        patch.setattr("labeling.in_process.observe_sweeps", interrupt)
        code, _, err = label(*logs)
    assert code == 130
    assert len(err) == 1
    assert "interrupted: finished segments are kept" in err[0]
    (manifest,) = LabelFolder.open(tmp_path / "out").manifests
    assert [segment.state for segment in manifest.segments] == ["SUCCEEDED", "FAILED"]
    assert manifest.segments[1].reason == "not labelled yet"
    assert label(*logs)[0] == 0
    assert LabelFolder.open(tmp_path / "out").manifests[0].is_complete


def test_killed_between_shards_and_manifest(write_log, label, tmp_path):
    log = write_log()
    label(log)
    complete = files(tmp_path / "out")
    for path in (tmp_path / "out/manifests").iterdir():
        path.unlink()
    code, out, _ = label(log)
    assert code == 0
    assert "already there" in out
    assert files(tmp_path / "out") == complete


def test_killed_between_two_shards(write_log, label, tmp_path):
    log = write_log()
    label(log)
    complete = files(tmp_path / "out")
    for folder in ("manifests", "sweeps"):
        for path in (tmp_path / "out" / folder).iterdir():
            path.unlink()
    assert label(log)[0] == 0
    assert files(tmp_path / "out") == complete


def test_a_bug_elsewhere_is_one_line_and_its_trace_one_variable_away(write_log, label, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("labeling.run.make_manifest", broken)
    code, _, err = label(write_log())
    assert code == 1
    assert err == [
        "motionlabel: internal error: ZeroDivisionError: division by zero (set MOTIONLABEL_DEBUG=1 to see the trace)"
    ]
    monkeypatch.setitem(os.environ, "MOTIONLABEL_DEBUG", "1")
    code, _, err = label(write_log())
    assert code == 1
    assert "Traceback (most recent call last):" in err


def test_the_demo_runs_and_runs_again(cli, tmp_path):
    arguments = ("demo", "--in-process", "--output", tmp_path / "out", "--sweeps", 2)
    code, out, err = cli(*arguments)
    assert (code, err) == (0, [])
    assert "Boxes" in out
    assert f"picture: {tmp_path / 'out/picture.png'}" in out
    assert f"shards:  {tmp_path / 'out'}/labels" in out
    assert (tmp_path / "out/picture.png").stat().st_size > 10_000
    code, again, _ = cli(*arguments)
    assert code == 0
    assert "1 segment was already there" in again
    assert again.partition("\n\n")[2] == out.partition("\n\n")[2]  # the same figures
