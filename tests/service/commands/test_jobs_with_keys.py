"""The clients against a real server that asks for API keys. The token is told by a file or the environment only."""

import pytest

from service.keys import Scope, revoke_key

STREET = "synthetic:street?sweeps=30"


@pytest.fixture
def server(keyed, running):
    with running(keyed) as url:
        yield url


@pytest.fixture
def submission(server, settings):
    return ("submit", STREET, "--dataset", "synthetic", "--output", f"{settings.data_roots[0]}/out")


@pytest.fixture
def token_file(tmp_path, issue):
    path = tmp_path / "token"
    path.write_text(f"{issue('ann')}\n")
    return path


def test_each_command_takes_its_key_from_a_file(cli, submission, token_file):
    code, job, err = cli(*submission, "--api-key-file", token_file)
    assert (code, err) == (0, [])
    job = job.strip()
    assert job in cli("status", "--api-key-file", token_file)[1]
    assert cli("status", job, "--api-key-file", token_file)[0] == 0
    assert cli("cancel", job, "--api-key-file", token_file)[:2] == (
        0,
        cli("status", job, "--api-key-file", token_file)[1],
    )
    assert cli("watch", job, "--api-key-file", token_file)[0] == 1  # cancelled
    assert cli("retry", job, "--api-key-file", token_file)[0] == 0


def test_or_from_the_environment_where_the_file_comes_first(cli, submission, token_file, issue, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_API_KEY", issue("bob"))
    code, out, _ = cli(*submission)
    assert code == 0
    assert out.strip() in cli("status")[1]
    assert out.strip() not in cli("status", "--api-key-file", token_file)[1]
    monkeypatch.setenv("MOTIONLABEL_API_KEY_FILE", str(token_file))
    assert out.strip() not in cli("status")[1]


@pytest.mark.parametrize("command", ["submit", "status", "status x", "watch x", "cancel x", "retry x"])
def test_without_a_key_each_says_where_one_goes(cli, submission, server, command):
    arguments = submission if command == "submit" else command.split()
    code, out, err = cli(*arguments)
    assert (code, out) == (2, "")
    assert err == [
        f"motionlabel: {server} takes no call without an API key that it knows: "
        "put its token into MOTIONLABEL_API_KEY, or into a file that --api-key-file names"
    ]


def test_a_revoked_key_is_one_line_without_the_token(cli, submission, issue, keyed, monkeypatch, caplog):
    token = issue("ann")
    monkeypatch.setenv("MOTIONLABEL_API_KEY", token)
    assert cli(*submission)[0] == 0
    revoke_key(keyed.api_keys_file, token[3:11])
    code, out, err = cli(*submission)
    assert (code, out, len(err)) == (2, "", 1)
    assert token[12:] not in err[0] + caplog.text


def test_a_key_that_may_only_look_is_told_so(cli, submission, issue, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_API_KEY", issue("ann", Scope.READ))
    assert cli("status")[0] == 0
    assert cli(*submission) == (2, "", ["motionlabel: the key has no scope submit, which this needs"])


@pytest.mark.parametrize("text", ["ml_zz zz", "ml_zz\nHost: zz", "ml_zz\u00e4", "ml_zz\x07", "zz\x00"])
def test_what_is_no_token_is_not_sent_and_not_repeated(cli, submission, tmp_path, text):
    path = tmp_path / "token"
    path.write_text(text)
    code, out, err = cli(*submission, "--api-key-file", path)
    assert (code, out, len(err)) == (2, "", 1)
    assert "ml_..." in err[0]
    assert "zz" not in err[0]


@pytest.mark.parametrize("text", ["", "\n", None])
def test_a_file_without_a_key_is_named(cli, submission, tmp_path, text):
    path = tmp_path / "token"
    if text is not None:
        path.write_text(text)
    code, out, err = cli(*submission, "--api-key-file", path)
    assert (code, out, len(err)) == (2, "", 1)
    assert str(path) in err[0]


@pytest.mark.parametrize("arguments", [["--api-key", "ml_s"], ["--api-key=ml_s"], ["--token=ml_s"], ["--key", "ml_s"]])
def test_no_option_takes_the_token_itself_and_none_repeats_it(cli, submission, arguments):
    code, out, err = cli(*submission, *arguments)
    assert (code, out, len(err)) == (2, "", 1)
    assert "ml_s" not in err[0]


def test_no_url_carries_a_secret(cli, issue, server):
    token = issue()
    code, out, err = cli("status", "--server", server.replace("//", f"//ann:{token}@"))
    assert (code, out, len(err)) == (2, "", 1)
    assert token[12:] not in err[0]
    assert "--api-key-file" in err[0]


def test_a_service_that_is_not_there_is_one_line_without_the_token(cli, issue, monkeypatch):
    token = issue()
    monkeypatch.setenv("MOTIONLABEL_API_KEY", token)
    monkeypatch.setenv("MOTIONLABEL_DEBUG", "1")
    code, out, err = cli("status", "--server", "http://127.0.0.1:9")
    assert (code, out) == (1, "")
    assert token[12:] not in "\n".join(err)


def test_the_settings_show_no_token(issue, monkeypatch):
    from service.settings import read_settings

    token = issue()
    monkeypatch.setenv("MOTIONLABEL_API_KEY", token)
    assert token[12:] not in repr(read_settings())
    assert token[12:] not in read_settings().model_dump_json()
