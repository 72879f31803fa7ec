"""The clients against a real server on this machine. A dispatcher is played by the test."""

import socket
from types import SimpleNamespace

import pytest

from service.commands import jobs

STREET = "synthetic:street?sweeps=30"


@pytest.fixture
def submit(server, cli, settings):
    """Return a function that submits segments and returns the job's id."""

    def run(*arguments):
        output = f"{settings.data_roots[0]}/out"
        code, out, err = cli("submit", *arguments, "--dataset", "synthetic", "--output", output)
        assert (code, err) == (0, [])
        return out.strip()

    return run


@pytest.fixture
def quick_polls(monkeypatch):
    monkeypatch.setattr(jobs, "POLL_S", 0.01)


def test_submit_prints_the_id_and_hands_everything_on(submit, queue):
    job = submit(
        STREET, "--profile", "fast", "--sweeps", "2:8", "--points", "--set", "tracking.min_sweeps=7",
        "--priority", "5", "--deadline-s", "60", "--client-job-id", "mine",
    )  # fmt: skip
    claim = queue.claim_segment("test", lease_s=60)
    assert (claim.job_id, claim.uri) == (job, STREET)
    assert claim.config["profile"] == "fast"
    assert claim.config["sweeps"] == [2, 8]
    assert claim.config["write_points"] is True
    assert claim.config["tracking"]["min_sweeps"] == 7


def test_submit_of_the_same_changes_nothing(submit):
    assert submit(STREET, "--client-job-id", "mine") == submit(STREET, "--client-job-id", "mine")


def test_paths_are_those_of_the_callers_folder(server, cli, settings, queue, monkeypatch):
    monkeypatch.chdir(settings.data_roots[0])
    flow = ("--set", "flow.method=external", "--set", "flow.external_folder=flow")
    code, _, err = cli("submit", "logs/a", "--dataset", "av2", "--output", "out", *flow)
    assert (code, err) == (0, [])
    claim = queue.claim_segment("test", lease_s=60)
    assert (claim.uri, claim.output_uri) == (f"{settings.data_roots[0]}/logs/a", f"{settings.data_roots[0]}/out")
    assert claim.config["flow"]["external_folder"] == f"{settings.data_roots[0]}/flow"


def test_status_of_a_job_as_it_goes_on(cli, submit, finish, end_jobs, settings):
    job = submit(STREET, f"{STREET}0")
    labels_at = f"labels: {settings.data_roots[0]}/out"
    assert cli("status", job) == (0, f"{job} QUEUED 0%: 2 QUEUED; {labels_at}\n", [])
    finish()
    code, out, err = cli("status", job)
    assert (code, err) == (0, [])
    assert out.startswith(f"{job} RUNNING 50%, ")
    assert out.endswith(f" s to go: 1 QUEUED, 1 SUCCEEDED; {labels_at}\n")
    finish("FAILED")
    end_jobs()
    code, out, err = cli("status", job)
    assert (code, out) == (3, f"{job} PARTIAL 100%: 1 SUCCEEDED, 1 FAILED; {labels_at}\n")
    assert f"motionlabel: {STREET}0 FAILED: no sweeps" in err


def test_status_of_the_service(cli, submit):
    job = submit(STREET)
    code, out, err = cli("status")
    assert (code, err) == (0, [])
    counts, segments, dispatchers, latest = out.splitlines()
    assert counts == "jobs: 1 QUEUED"
    assert segments == "segments: 0 running, 1 waiting"
    assert dispatchers == "dispatchers: 0, workers: 0"
    assert latest.startswith(f"{job} QUEUED 0% synthetic ")


@pytest.mark.parametrize(("ends", "code"), [(["SUCCEEDED"], 0), (["SUCCEEDED", "FAILED"], 3), (["FAILED"], 1)])
def test_watch_waits_and_its_exit_code_tells(cli, submit, finish, end_jobs, monkeypatch, ends, code):
    job = submit(*(f"{STREET}{number}" for number in range(len(ends))))
    remaining = list(ends)

    def work(_):  # between two polls
        if remaining:
            finish(remaining.pop(0))
        else:
            end_jobs()

    monkeypatch.setattr(jobs, "time", SimpleNamespace(sleep=work))
    got, out, err = cli("watch", job)
    assert got == code
    assert len(out.splitlines()) == 1
    assert out.startswith(f"{job} ")
    assert "100%" in out
    assert bool(err) == (code != 0)


def test_watch_outlives_a_service_that_starts_anew(cli, submit, finish, end_jobs, quick_polls, monkeypatch):
    job = submit(STREET)
    finish()
    end_jobs()
    states = iter(["RUNNING", None, None, "SUCCEEDED"])
    get_job = jobs._get_job

    def get(client, name):
        from service.client import ServiceError

        state = next(states)
        if state is None:
            raise ServiceError("cannot reach it")
        return get_job(client, name).model_copy(update={"state": jobs.JobState(state)})

    monkeypatch.setattr(jobs, "_get_job", get)
    assert cli("watch", job)[0] == 0


def test_watch_does_not_wait_for_ever(cli, quick_polls, submit, monkeypatch):
    job = submit(STREET)
    asked = []

    def get(client, name):
        from service.client import ServiceError

        asked.append(name)
        if len(asked) > 1:
            raise ServiceError("cannot reach it")
        return get_job(client, name)

    get_job = jobs._get_job
    monkeypatch.setattr(jobs, "_get_job", get)
    assert cli("watch", job) == (1, "", ["motionlabel: cannot reach it"])


def test_cancel_and_retry(cli, submit):
    job = submit(STREET)
    code, out, err = cli("cancel", job)
    assert (code, err) == (0, [])
    assert out.startswith(f"{job} CANCELLED")
    code, out, err = cli("retry", job)
    assert (code, err) == (0, [])
    assert out.startswith(f"{job} QUEUED")
    assert cli("retry", job) == (2, "", [f"motionlabel: job {job} is QUEUED: wait until it has ended, or cancel it"])


@pytest.mark.parametrize("command", ["status", "watch", "cancel", "retry"])
def test_an_unknown_job_is_one_line(cli, server, command):
    assert cli(command, "nobody") == (2, "", ["motionlabel: no job nobody"])
    code, out, err = cli(command, "a/../b?c")
    assert (code, out, len(err)) == (2, "", 1)
    assert "'a/../b?c' is not the id of a job" in err[0]


def test_what_the_service_refuses_is_one_line(cli, server, settings):
    code, out, err = cli("submit", STREET, "--dataset", "synthetic", "--output", "/elsewhere")
    assert (code, out) == (2, "")
    assert err == [
        f"motionlabel: /output_uri: /elsewhere lies under no data root ({settings.data_roots[0]}): "
        "MOTIONLABEL_DATA_ROOTS of the server names them; an API key may name fewer"
    ]


@pytest.mark.parametrize("url", ["nonsense", "ftp://127.0.0.1", "http://", "http://[::1"])
def test_what_is_no_url_is_one_line(cli, url):
    code, out, err = cli("status", "--server", url)
    assert (code, out, len(err)) == (2, "", 1)
    assert f"--server {url}: " in err[0]


def test_a_service_that_is_not_there_is_one_line(cli, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    code, out, err = cli("status", "--server", f"http://127.0.0.1:{port}/")
    assert (code, out, len(err)) == (1, "", 1)
    assert f"cannot reach http://127.0.0.1:{port}: " in err[0]
    assert "motionlabel serve" in err[0]


def test_another_kind_of_server_is_one_line(cli, server):
    code, out, err = cli("status", "--server", f"{server}/other")
    assert (code, out, len(err)) == (2, "", 1)
    assert "Not Found: GET /other/v1/status" in err[0]


OTHER_JSON = [{}, [], [1], {"jobs": []}, {"jobs": [{}], "next_page_token": None}, "text", 1, {"detail": None}]


@pytest.mark.parametrize("answer", OTHER_JSON, ids=str)
@pytest.mark.parametrize("command", [["status"], ["status", "a"], ["watch", "a"], ["cancel", "a"], ["retry", "a"]])
def test_a_server_that_answers_other_json_is_one_line(cli, monkeypatch, command, answer):
    monkeypatch.setattr("service.client.Client._call", lambda *_, **__: answer)
    code, out, err = cli(*command)
    assert (code, out, len(err)) == (1, "", 1)
    assert "the server is no motionlabel service, or one of another version: " in err[0]


@pytest.mark.parametrize("seconds", ["nan", "inf", "-1", "0", "1e12"])
def test_a_deadline_that_is_none_is_one_line(cli, seconds):
    code, out, (line,) = cli("submit", STREET, "--dataset", "synthetic", "--output", "/o", "--deadline-s", seconds)
    assert (code, out) == (2, "")
    assert f"--deadline-s {float(seconds):g}: expected seconds above 0 and up to" in line


@pytest.mark.parametrize("text", ["NaN", "Infinity", "1e999"])
def test_a_number_that_json_has_not_is_refused_by_the_service_by_name(cli, server, settings, text):
    arguments = ["--dataset", "synthetic", "--output", f"{settings.data_roots[0]}/out"]
    code, out, (line,) = cli("submit", STREET, *arguments, "--set", f"flow.learning_rate={text}")
    assert (code, out) == (2, "")
    assert f"option flow.learning_rate='{text}': Input should be a finite number" in line
