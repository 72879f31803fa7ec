"""`backfill` stopped, started twice, cut off: each segment is submitted once, and none is lost."""

import json
import os
import signal
import subprocess
import sys
import time

import httpx2

from labeling.storage.storage import open_storage
from schemas.backfill import BackfillSummary
from schemas.errors import StorageTrouble
from service.client import Client, ServiceError
from workers.jobs.tables import events, jobs, segments


def test_once_more_asks_the_service_for_nothing(backfill, service, names, root, posts):
    backfill()
    del posts[:]
    assert backfill() == (0, f"{root}/out: 0 of 0 segments labelled, in 0 jobs\n7 segments labelled before\n", [])
    assert posts == []
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


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


def test_a_retry_whose_answer_was_lost_is_followed(backfill, service, monkeypatch):
    service.states = {"log0": "FAILED"}
    assert backfill()[0] == 3
    service.states = {}
    post, lost = Client.post, []

    def lose_first(self, path, body=None):
        answer = post(self, path, body)
        if path.endswith(":retry") and not lost:
            lost.append(path)
            raise ServiceError("connection reset")
        return answer

    monkeypatch.setattr(Client, "post", lose_first)
    code, _, err = backfill("--retry")
    assert (code, err, len(lost)) == (0, [], 1)


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
        for table in (events, segments, jobs):
            connection.execute(table.delete())
    assert backfill()[0] == 0
    assert service.count(f"{root}/out") == dict.fromkeys(names, 1)


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


def test_a_disk_that_fails_under_the_search_is_one_line(backfill, service, monkeypatch):
    monkeypatch.setattr(
        "service.commands.backfill.find_segments", lambda *_: (_ for _ in ()).throw(StorageTrouble("drives: I/O error"))
    )
    assert backfill() == (1, "", ["motionlabel: drives: I/O error"])
