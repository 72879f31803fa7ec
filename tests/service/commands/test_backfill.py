"""`backfill`: what it submits, tells, refuses and returns."""

import contextlib
from collections import Counter

import pytest

from labeling.readers.discovery import shard_of
from labeling.storage.storage import open_storage
from schemas.backfill import BackfillSummary
from service.backfill import Pace, new_batches
from service.ledger import Ledger


def test_every_segment_is_submitted_once_and_labelled(backfill, service, names, root):
    code, out, err = backfill()
    assert (code, err) == (0, [])
    assert out.splitlines()[0] == f"{root}/out: 7 of 7 segments labelled, in 4 jobs"
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_no_more_is_in_flight_than_is_said(backfill, service):
    seen = []
    service.before_wait = lambda: seen.append(service.num_in_flight())
    assert backfill()[0] == 0
    assert max(seen) == 4
    del seen[:]
    assert backfill("--batch-size", "3", "--max-in-flight", "3", output="out2")[0] == 0
    assert max(seen) == 3


def test_what_is_asked_of_each_segment_is_handed_on(backfill, service, queue):
    service.num_cpus = 0
    claims = []

    def look():
        claims.append(queue.claim_segment("test", lease_s=600))
        raise KeyboardInterrupt

    service.before_wait = look
    options = ("--profile", "fast", "--sweeps", "2:8", "--points", "--set", "tracking.min_sweeps=7")
    assert backfill(*options, "--priority", "5")[0] == 130
    (claim,) = claims
    assert claim.config["profile"] == "fast"
    assert claim.config["sweeps"] == [2, 8]
    assert claim.config["write_points"] is True
    assert claim.config["tracking"]["min_sweeps"] == 7


def test_a_dry_run_prints_what_would_be_submitted_and_submits_nothing(backfill, names, root, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_SERVER", "http://127.0.0.1:9")  # it needs no service
    code, out, err = backfill("--dry-run")
    assert (code, err) == (0, ["7 segments would be submitted, in 4 jobs"])
    assert set(out.splitlines()) == names
    assert not open_storage(root).has_folder("out")


def test_a_dry_run_leaves_out_what_was_asked_for(backfill, service, names):
    assert backfill("--limit", "3")[0] == 0
    _, out, err = backfill("--dry-run")
    assert err == ["4 segments would be submitted, in 2 jobs"]
    assert len(set(out.splitlines()) & names) == 4
    assert backfill("--dry-run", "--limit", "1")[2] == ["1 segment would be submitted, in 1 job"]


def test_a_limit_is_one_of_new_segments(backfill, service, root):
    totals = []
    for _ in range(4):
        assert backfill("--limit", "3")[0] == 0
        totals.append(len(service.count(f"{root}/out")))
    assert totals == [3, 6, 7, 7]
    assert set(service.count(f"{root}/out").values()) == {1}


def test_no_more_is_searched_than_a_limit_needs(tmp_path):
    def search():
        yield from ("a", "b", "a", "c")
        raise AssertionError("searched on")

    with contextlib.closing(Ledger(open_storage(tmp_path), {})) as ledger:
        assert list(new_batches(search(), ledger, Pace(2, 2, limit=4))) == [["a", "b"], ["a", "c"]]
        assert list(new_batches(search(), ledger, Pace(9, 9, limit=4))) == [["a", "b", "c"]]


def test_shares_make_the_whole_and_do_not_overlap(backfill, service, names, root):
    for shard in ("1/3", "3/3", "2/3", "1/3"):
        before = set(service.count(f"{root}/out"))
        assert backfill("--shard", shard)[0] == 0
        index = int(shard[0]) - 1
        new = set(service.count(f"{root}/out")) - before
        assert new <= {name for name in names if shard_of("av2", name, 3) == index}
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_since_looks_at_when_sweeps_were_written(backfill, service, place, root):
    sweep = open_storage(f"{place}/val/log6/sensors/lidar")
    sweep.publish("1.feather", b"")
    assert backfill("--since", "2020-01-01")[0] == 0
    assert service.count(f"{root}/out") == {f"{place}/val/log6": 1}
    assert backfill("--since", "2999-01-01T06:00Z")[:2] == (
        0,
        f"{root}/out: 0 of 0 segments labelled, in 0 jobs\n1 segment labelled before\n",
    )


def test_what_went_wrong_is_told_and_the_exit_code_says_so(backfill, service, root, tmp_path):
    service.states = {"log0": "FAILED", "log5": "PARTIAL"}
    code, out, err = backfill("--json", tmp_path / "summary.json")
    assert code == 3
    assert out.startswith(f"{root}/out: 5 of 7 segments labelled, in 4 jobs, 1 PARTIAL, 1 FAILED\n")
    assert err
    assert all("has ended PARTIAL: see `motionlabel status " in line for line in err)
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert summary.is_complete
    assert Counter({state: n for state, n in summary.segments.items() if n}) == {
        "SUCCEEDED": 5,
        "FAILED": 1,
        "PARTIAL": 1,
    }


def test_none_labelled_is_a_failure(backfill, service, names):
    service.states = dict.fromkeys((name.rpartition("/")[2] for name in names), "FAILED")
    assert backfill()[0] == 1


def test_the_summary_has_rate_and_price(backfill, service, tmp_path):
    assert backfill("--json", tmp_path / "summary.json")[0] == 0
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert summary.elapsed_s == service.now_s == service.num_waits  # a second each
    assert summary.segments_per_hour == pytest.approx(7 * 3600 / summary.elapsed_s)
    # Of the looks, those after which two segments, or the last one, were at work.
    assert 3 * service.num_cpus / 3600 < summary.core_hours < summary.elapsed_s * service.num_cpus / 3600
    assert (summary.num_expected, summary.num_segments, summary.num_ended) == (7, 7, 7)
    assert (summary.eta_s, summary.expected_core_hours) == (0, summary.core_hours)


def test_a_log_gets_a_line_now_and_then(backfill, service, monkeypatch):
    monkeypatch.setattr("service.commands.backfill._LINE_EVERY_S", 2.0)
    code, _, err = backfill()
    assert code == 0
    assert err[0] == "2 of 7 segments, 2 jobs, 3600 segments/h, 0.00 of 0.00 core-hours, 0:00:05 to go"
    assert len(err) == service.now_s // 2


def test_rest_and_price_are_told_on_the_way(backfill, service, tmp_path):
    def stop():
        if service.num_waits == 2:
            raise KeyboardInterrupt

    service.before_wait = stop
    assert backfill("--json", tmp_path / "summary.json")[0] == 130
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert (summary.num_ended, summary.elapsed_s) == (2, 2)  # two began in the first second, and ended in the next one
    assert summary.eta_s == 5
    assert summary.core_hours == pytest.approx(2 * service.num_cpus / 3600)
    assert summary.expected_core_hours == pytest.approx(7 / 2 * summary.core_hours)


def test_a_segment_that_the_service_does_not_take_is_told_and_the_others_are_labelled(
    backfill, service, names, place, root, tmp_path
):
    outside = tmp_path / "outside"
    open_storage(outside).prepare(("sensors/lidar",))
    (tmp_path / "data/drives/val/link").symlink_to(outside)
    (tmp_path / "data/drives/val/same").symlink_to(f"{place}/train/log0")
    for _ in range(2):
        code, out, err = backfill("--batch-size", "8")
        assert code == 3
        assert "1 refused" in out
        assert [line.partition(" lies under no data root")[0] for line in err] == [
            f"motionlabel: {outside} is refused: /segments/0: {outside}"
        ]
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_a_place_that_the_service_does_not_take_at_all_ends_it(cli, service, root, tmp_path):
    open_storage(tmp_path / "outside").prepare(("a/sensors/lidar", "b/sensors/lidar"))
    code, out, (line,) = cli("backfill", tmp_path / "outside", "--dataset", "av2", "--output", f"{root}/out")
    assert (code, out) == (2, "")
    assert "lies under no data root" in line


def test_a_folder_whose_name_no_place_has_is_told_once(backfill, service, place):
    open_storage(place).prepare(("a\nb/sensors/lidar",))
    code, out, (line,) = backfill()
    assert code == 3
    assert "7 of 7 segments labelled" in out
    assert ", 1 left out" in out
    assert r"drives/a\nb' is left out" in line


def test_a_segment_with_two_names_is_one(backfill, service, names, place, root, tmp_path):
    (tmp_path / "data/drives/again").symlink_to(f"{place}/train")
    assert backfill("--json", tmp_path / "summary.json")[0] == 0
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert (summary.num_expected, summary.num_segments, summary.eta_s) == (7, 7, 0)
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_an_output_that_cannot_be_written_is_one_line(backfill, service, root, tmp_path):
    (tmp_path / "data/out").write_text("")
    code, _, (line,) = backfill()
    assert code == 2
    assert line.endswith("choose another --output, or a --ledger where this command may write")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--shard", "5/4"], "--shard 5/4: expected I/N with I from 1 to N, as 1/4 to 4/4 for four shares"),
        (["--shard", "0/4"], "--shard 0/4: expected I/N"),
        (["--shard", "1"], "--shard 1: expected I/N"),
        (["--shard", "1/٤"], "expected I/N"),
        (["--since", "yesterday"], "--since yesterday: expected a date as 2026-11-28, or a time as 2026-11-28T06:00Z"),
        (
            ["--batch-size", "5", "--max-in-flight", "4"],
            "--batch-size 5: a job has at most --max-in-flight segments, 4",
        ),
        (["--batch-size", "0"], "Invalid value for '--batch-size'"),
        (["--batch-size", "5000"], "Invalid value for '--batch-size'"),
        (["--limit", "0"], "Invalid value for '--limit'"),
        (["--dry-run", "--retry"], "--dry-run submits nothing"),
        (["--dry-run", "--json", "x.json"], "--dry-run submits nothing"),
        (["--json", "no/folder/x.json"], "--json no/folder/x.json: no folder "),
        (["--set", "flow.nonsense=1"], "nonsense"),
        (["--profile", "best"], "best"),
        (["--priority", "101"], "--priority"),
        (["--ledger", "gs://bucket"], "gs://bucket"),
    ],
)
def test_wrong_options_are_one_line(backfill, options, message):
    code, out, err = backfill(*options)
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]


def test_nothing_found_says_what_a_segment_looks_like(cli, root):
    open_storage(f"{root}/empty").prepare(("sub/lidar",))
    arguments = ("--dataset", "av2", "--output", f"{root}/out")
    code, out, (line,) = cli("backfill", f"{root}/empty", *arguments)
    assert (code, out) == (2, "")
    rule = "a segment of dataset av2 is a folder that has sensors/lidar/ in it"
    assert line == f"motionlabel: {root}/empty: no segment found: {rule}"
    code, _, (line,) = cli("backfill", f"{root}/none", *arguments)
    assert (code, f"{root}/none: no such folder" in line) == (2, True)
    open_storage(f"{root}/empty").prepare(("a\nb/sensors/lidar",))
    assert "is left out with all that it holds" in cli("backfill", f"{root}/empty", *arguments)[2][0]


def test_a_data_set_that_lies_nowhere_or_is_none_is_one_line(cli, root):
    for dataset, message in {"synthetic": "lie in no folder", "waymo": "unknown dataset 'waymo'"}.items():
        code, _, (line,) = cli("backfill", root, "--dataset", dataset, "--output", f"{root}/out")
        assert (code, message in line) == (2, True)


def test_a_service_that_is_not_there_is_one_line_and_leaves_nothing(backfill, root, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_SERVER", "http://127.0.0.1:9")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    code, out, (line,) = backfill()
    assert (code, out) == (1, "")
    assert "cannot reach http://127.0.0.1:9" in line
    assert not open_storage(root).has_folder("out")


def test_a_bucket_is_filled_as_a_folder_is(cli, service, in_bucket, names, root):
    arguments = ("backfill", f"{in_bucket}/drives/", "--dataset", "av2", "--output", f"{in_bucket}/out")
    names = {name.replace(root, in_bucket) for name in names}
    pace = ("--batch-size", "2", "--max-in-flight", "4")
    code, out, err = cli(*arguments, "--dry-run")
    assert (code, set(out.splitlines()), err) == (0, names, ["7 segments would be submitted, in 1 job"])
    assert cli(*arguments, *pace, "--limit", "4", "--since", "2020-01-01")[0] == 0
    code, out, err = cli(*arguments, *pace)
    assert (code, err) == (0, [])
    assert out.splitlines()[1] == "4 segments labelled before"
    assert service.count(f"{in_bucket}/out") == dict.fromkeys(names, 1)
    assert cli(*arguments, "--since", "2999-01-01")[0] == 0


def test_a_bucket_that_is_missing_is_one_line(cli, service, in_bucket, root):
    arguments = ("--dataset", "av2", "--output")
    for place, output in (("s3://not-there/x", f"{root}/out"), (f"{in_bucket}/drives", "s3://not-there/out")):
        code, out, (line,) = cli("backfill", place, *arguments, output)
        assert (code, out) == (2, "")
        assert "s3://not-there/" in line
        assert "no such bucket" in line
