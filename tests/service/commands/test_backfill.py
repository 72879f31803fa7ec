"""`backfill` against a real server on this machine, with a dispatcher that is played by the test, in made-up time."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter

import httpx2
import pytest
from sqlalchemy import func, select

from labeling.readers.discovery import shard_of
from labeling.storage.storage import open_storage
from schemas.api.jobs import Failure, SegmentState
from schemas.backfill import BackfillSummary
from schemas.errors import StorageTrouble
from schemas.manifest import SegmentEntry, Shard
from service.client import Client, ServiceError
from workers.jobs.claims import Dispatcher
from workers.jobs.tables import jobs, segments

LOGS = (*(f"train/log{k}" for k in range(5)), "val/deep/log5", "val/log6")
NUM_CPUS = 2


class Service:
    """A dispatcher of two CPUs: whenever ``backfill`` waits, it ends what it had at work and begins what it can."""

    def __init__(self, queue, end_jobs):
        self._queue, self._end_jobs = queue, end_jobs
        self._claims = []
        self.now_s = 0.0  # by the clock of ``backfill``
        self.num_waits = 0
        self.num_cpus = NUM_CPUS
        self.states = {}  # of segments by their last names; others are SUCCEEDED
        self.before_wait = lambda: None

    def monotonic(self):
        return self.now_s

    def sleep(self, seconds):
        self.before_wait()
        self.now_s += seconds
        self.num_waits += 1
        self._queue.heartbeat(Dispatcher(id="d", host="h", pid=1, code_version="1", num_workers=self.num_cpus))
        for claim in self._claims:
            self._finish(claim)
        waiting = (self._queue.claim_segment("d", lease_s=600) for _ in range(self.num_cpus))
        self._claims = [claim for claim in waiting if claim is not None]
        self._end_jobs()

    def _finish(self, claim):
        state = SegmentState(self.states.get(claim.uri.rpartition("/")[2], "SUCCEEDED"))
        if state in ("FAILED", "CRASHED"):
            self._queue.finish(claim, state, failure=Failure(error="InvalidInput", message="no sweeps"))
        else:
            shard = Shard(table="labels", path="labels/x.parquet", rows=7, bytes=100, sha256="0" * 64)
            self._queue.finish(
                claim, state, entry=SegmentEntry(segment_id="x", uri=claim.uri, state=state, shards=(shard,))
            )

    def count(self, output):
        """How often each segment was submitted for an output."""
        query = select(segments.c.uri, func.count()).join(jobs).where(jobs.c.output_uri == str(output))
        with self._queue._database.read() as connection:
            return dict(connection.execute(query.group_by(segments.c.uri)).all())

    def num_in_flight(self):
        with self._queue._database.read() as connection:
            is_open = segments.c.state.in_((SegmentState.QUEUED, SegmentState.RUNNING))
            return connection.execute(select(func.count()).where(is_open)).scalar_one()


@pytest.fixture
def service(server, queue, end_jobs, monkeypatch):
    service = Service(queue, end_jobs)
    monkeypatch.setattr("service.backfill.time", service)
    return service


@pytest.fixture
def root(settings):
    return settings.data_roots[0]


@pytest.fixture
def place(root):
    """Seven logs at two depths, of which nothing but the folders are there: nobody opens them."""
    for name in LOGS:
        open_storage(f"{root}/drives").prepare((f"{name}/sensors/lidar",))
    return f"{root}/drives"


@pytest.fixture
def names(place):
    return {f"{place}/{name}" for name in LOGS}


@pytest.fixture
def backfill(cli, place, root):
    """Return a function that runs ``backfill``, two segments a job, four in flight."""

    def run(*arguments, output="out"):
        pace = () if "--batch-size" in arguments else ("--batch-size", "2", "--max-in-flight", "4")
        return cli("backfill", place, "--dataset", "av2", "--output", f"{root}/{output}", *pace, *arguments)

    return run


@pytest.fixture
def posts(monkeypatch):
    """What is posted from now on."""
    paths, post = [], Client.post
    monkeypatch.setattr(Client, "post", lambda self, path, body=None: (paths.append(path), post(self, path, body))[1])
    return paths


def test_every_segment_is_submitted_once_and_labelled(backfill, service, names, root):
    code, out, err = backfill()
    assert (code, err) == (0, [])
    assert out.splitlines()[0] == f"{root}/out: 7 of 7 segments labelled, in 4 jobs"
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_once_more_asks_the_service_for_nothing(backfill, service, names, root, posts):
    backfill()
    del posts[:]
    assert backfill() == (0, f"{root}/out: 0 of 0 segments labelled, in 0 jobs\n7 segments labelled before\n", [])
    assert posts == []
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


def test_none_labelled_is_a_failure(backfill, service):
    service.states = dict.fromkeys((name.rpartition("/")[2] for name in LOGS), "FAILED")
    assert backfill()[0] == 1


def test_what_is_without_labels_is_looked_at_again_and_run_again_when_asked_to(backfill, service, names, root):
    service.states = {"log0": "FAILED", "log5": "PARTIAL"}
    assert backfill()[0] == 3
    service.states = {}
    assert backfill()[0] == 3  # nobody has run it again
    code, out, _ = backfill("--retry")
    assert code == 3  # a partial one has labels, so it is not run again
    assert "1 PARTIAL" in out
    assert "FAILED" not in out
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_the_summary_has_rate_and_price(backfill, service, tmp_path):
    assert backfill("--json", tmp_path / "summary.json")[0] == 0
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert summary.elapsed_s == service.now_s == service.num_waits  # a second each
    assert summary.segments_per_hour == pytest.approx(7 * 3600 / summary.elapsed_s)
    # Of the looks, those after which two segments, or the last one, were at work.
    assert 3 * NUM_CPUS / 3600 < summary.core_hours < summary.elapsed_s * NUM_CPUS / 3600
    assert (summary.num_expected, summary.num_segments, summary.num_ended) == (7, 7, 7)
    assert (summary.eta_s, summary.expected_core_hours) == (0, summary.core_hours)


def test_what_is_to_come_is_known_before_it_was_submitted(backfill, service, tmp_path):
    def stop():
        if service.num_waits == 1:
            raise KeyboardInterrupt

    service.before_wait = stop
    code, _, err = backfill("--json", tmp_path / "summary.json")
    assert (code, len(err)) == (130, 1)
    assert "the same command goes on from there" in err[0]
    summary = BackfillSummary.model_validate_json((tmp_path / "summary.json").read_text())
    assert not summary.is_complete
    assert summary.num_segments < summary.num_expected == 7
    assert summary.eta_s is None  # none has ended


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
    assert summary.core_hours == pytest.approx(2 * NUM_CPUS / 3600)
    assert summary.expected_core_hours == pytest.approx(7 / 2 * summary.core_hours)


class Killed(BaseException):
    """Nothing catches it, as nothing catches kill -9."""


def test_a_run_that_is_stopped_at_any_step_is_taken_up_where_it_was(backfill, service, names, root, monkeypatch):
    """After whatever can be seen from outside: each call of the service, each file of the ledger."""
    left = 0
    service.num_cpus = 8

    def counted(function):
        def call(*arguments, **options):
            nonlocal left
            answer = function(*arguments, **options)
            left -= 1
            if left == 0:
                raise Killed
            return answer

        return call

    for owner, name in ((Client, "post"), (Client, "get"), (type(open_storage(root)), "publish")):
        monkeypatch.setattr(owner, name, counted(getattr(owner, name)))
    pace = ("--batch-size", "4", "--max-in-flight", "4")
    step = 0
    while True:
        step += 1
        left = step
        output = f"out{step}"
        try:
            code, _, _ = backfill(*pace, output=output)
        except Killed:
            code, _, err = backfill(*pace, output=output)
            assert (code, err) == (0, [])
            assert service.count(f"{root}/{output}") == dict.fromkeys(names, 1)
        else:
            break
    assert code == 0
    assert step > 10


def test_two_who_press_the_same_button_get_one_set_of_jobs(backfill, service, names, root):
    """The second one runs whole while the first one waits for room."""

    def press():
        service.before_wait = lambda: None
        assert backfill()[0] == 0

    service.before_wait = press
    assert backfill()[0] == 0
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_a_service_that_starts_anew_is_waited_for(backfill, service, names, root, monkeypatch):
    calls, call = [], Client._call

    def fail_often(self, *arguments, **options):
        calls.append(arguments)
        if len(calls) > 1 and len(calls) % 3:
            raise ServiceError("starting")
        return call(self, *arguments, **options)

    monkeypatch.setattr(Client, "_call", fail_often)
    assert backfill()[0] == 0
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_a_service_that_has_too_much_to_do_is_asked_again(backfill, service, names, root, monkeypatch):
    answers, request = [], httpx2.Client.request

    def answer(self, method, path, **content):
        answers.append(path)
        if method == "POST" and len(answers) % 3:
            return httpx2.Response(429, json={"detail": "the queue is full"})
        return request(self, method, path, **content)

    monkeypatch.setattr(httpx2.Client, "request", answer)
    assert backfill()[0] == 0
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


def test_a_service_that_stays_away_ends_it_in_one_line(backfill, service, monkeypatch, tmp_path):
    def leave():
        monkeypatch.setattr(Client, "_call", lambda *_, **__: (_ for _ in ()).throw(ServiceError("cannot reach it")))

    service.before_wait = leave
    code, out, err = backfill("--json", tmp_path / "summary.json")
    assert (code, out, err) == (1, "", ["motionlabel: cannot reach it"])
    assert not json.loads((tmp_path / "summary.json").read_text())["is_complete"]


def test_a_job_store_that_was_lost_is_asked_anew(backfill, service, names, root, queue):
    """The records say what to ask for, and labels that are there are not made again."""
    service.before_wait = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    assert backfill()[0] == 130
    service.before_wait = lambda: None
    with queue._database.write() as connection:
        connection.execute(segments.delete())
        connection.execute(jobs.delete())
    assert backfill()[0] == 0
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


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


def test_records_may_lie_elsewhere(backfill, service, root, tmp_path):
    ledger = tmp_path / "ledger"
    assert backfill("--ledger", ledger)[0] == 0
    assert not open_storage(f"{root}/out").has_folder("backfill")
    assert backfill("--ledger", ledger, "--dry-run")[2] == ["0 segments would be submitted, in 0 jobs"]


def test_killed_by_the_system_and_taken_up(backfill, service, names, place, root):
    command = (sys.executable, "-m", "service", "backfill", place, "--dataset", "av2", "--output", f"{root}/out")
    for num_seen in (2, 4):
        process = subprocess.Popen([*command, "--batch-size", "2", "--max-in-flight", str(num_seen)])
        while len(service.count(f"{root}/out")) < num_seen:
            assert process.poll() is None
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert backfill()[0] == 0
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


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


def test_a_disk_that_fails_under_the_search_is_one_line(backfill, service, monkeypatch):
    monkeypatch.setattr(
        "service.commands.backfill.find_segments", lambda *_: (_ for _ in ()).throw(StorageTrouble("drives: I/O error"))
    )
    assert backfill() == (1, "", ["motionlabel: drives: I/O error"])


@pytest.fixture
def in_bucket(bucket):
    """The same logs in a bucket, which the service may read and write."""
    storage = open_storage(f"{bucket}/drives")
    for name in LOGS:
        storage.publish(f"{name}/sensors/lidar/1.feather", b"")
    return bucket


@pytest.fixture
def settings(settings, request):
    """A service that may use the bucket, in tests that have one."""
    if "bucket" not in request.fixturenames:
        return settings
    return settings.model_copy(update={"data_roots": (*settings.data_roots, request.getfixturevalue("bucket"))})


def test_a_bucket_is_filled_as_a_folder_is(cli, service, in_bucket):
    arguments = ("backfill", f"{in_bucket}/drives/", "--dataset", "av2", "--output", f"{in_bucket}/out")
    names = {f"{in_bucket}/drives/{name}" for name in LOGS}
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
