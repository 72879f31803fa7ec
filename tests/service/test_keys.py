"""The file of API keys: what it holds, who may change it, and that a running service follows it."""

import hmac
import json
import os
import stat
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from schemas.errors import InvalidInput
from service.keys import KeyRing, Scope, add_key, make_key, read_keys, revoke_key

ROOT = Path(__file__).resolve().parents[2]
NOW = datetime(2026, 6, 1, tzinfo=UTC)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "keys"


@pytest.fixture
def key():
    return make_key("ann", [Scope.SUBMIT])[0]


def line_of(key, **changes):
    return json.dumps(json.loads(key.model_dump_json(exclude_none=True)) | changes) + "\n"


def write(path, text, mode=0o600):
    """Write as an editor does: into the same file."""
    path.write_text(text)
    path.chmod(mode)
    changed_ns = path.stat().st_mtime_ns + 10**9  # clocks of file systems are coarse
    os.utime(path, ns=(changed_ns, changed_ns))


def test_the_file_holds_no_token(path):
    key, token = make_key("ann", [Scope.READ])
    add_key(path, key)
    assert token.startswith(f"ml_{key.id}_")
    assert token not in path.read_text()
    assert token.removeprefix(f"ml_{key.id}_") not in path.read_text()
    assert token not in repr(key)
    assert KeyRing(path).find(token) == key


def test_tokens_are_random():
    secrets = {make_key("ann", [Scope.READ])[1][12:] for _ in range(50)}
    assert len(secrets) == 50
    assert {len(secret) for secret in secrets} == {43}  # 256 bits in base64


def test_a_new_file_is_its_owners_alone_and_a_changed_one_keeps_its_mode(path, key):
    add_key(path, key)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    path.chmod(0o640)
    add_key(path, make_key("bob", [Scope.READ])[0])
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert [found.owner for found in read_keys(path)] == ["ann", "bob"]


def test_a_link_keeps_pointing_to_the_file(path, tmp_path, key):
    (tmp_path / "real").touch(mode=0o600)
    path.symlink_to("real")
    add_key(path, key)
    assert path.is_symlink()
    assert read_keys(tmp_path / "real") == (key,)


ADD_SOME = """
import sys
from pathlib import Path
from service.keys import Scope, add_key, make_key
for _ in range(5):
    add_key(Path(sys.argv[1]), make_key(sys.argv[2], [Scope.READ])[0])
"""


def test_commands_that_change_the_file_at_once_lose_nothing(path):
    command = [sys.executable, "-c", ADD_SOME, str(path)]
    commands = [subprocess.Popen([*command, f"owner-{number}"], cwd=ROOT) for number in range(4)]
    assert [command.wait(60) for command in commands] == [0] * 4
    assert len(read_keys(path)) == 20
    assert [found.name for found in path.parent.iterdir()] == ["keys"]


def test_a_change_that_fails_leaves_the_file_alone(path, key, monkeypatch):
    add_key(path, key)
    before = path.read_bytes()

    def fail(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(InvalidInput, match="No space left on device"):
        revoke_key(path, key.id)
    assert path.read_bytes() == before
    assert [found.name for found in path.parent.iterdir()] == ["keys"]


def test_a_revoked_key_is_gone_and_an_unknown_one_said(path, key):
    add_key(path, key)
    revoke_key(path, key.id)
    assert read_keys(path) == ()
    with pytest.raises(InvalidInput, match="no key of this id"):
        revoke_key(path, key.id)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "line 1: expected a JSON object"),
        ("[" * 100_000, "line 1: expected a JSON object"),
        ("[]", "line 1: a field of a key: Input should be"),
        ("\n\n{}", "line 3: id of a key: Field required"),
        ("\x00", "expected a JSON object"),
        ('{"id": "0', "expected a JSON object"),
    ],
)
def test_what_is_no_key_is_named_by_its_line(path, text, reason):
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(InvalidInput) as caught:
        read_keys(path)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"scopes": []},
        {"scopes": ["root"]},
        {"owner": ""},
        {"owner": "a b"},
        {"owner": "a\n"},
        {"owner": "<b>"},
        {"id": "0A0A0A0A"},
        {"id": ""},
        {"sha256": "0"},
        {"expires": "tomorrow"},
        {"expires": "2026-06-01T00:00:00"},
        {"roots": []},
        {"roots": ["relative"]},
        {"roots": ["/data/../etc"]},
        {"ml_0a0a0a0a_secret": 1},
    ],
    ids=str,
)
def test_a_line_that_says_anything_else_is_refused_without_a_word_of_it(path, key, changes):
    path.write_text(line_of(key, **changes))
    path.chmod(0o600)
    with pytest.raises(InvalidInput, match="line 1: ") as caught:
        read_keys(path)
    assert "ml_0a0a0a0a" not in str(caught.value)


def test_one_id_stands_for_one_key(path, key):
    path.write_text(line_of(key) + line_of(key, owner="bob"))
    path.chmod(0o600)
    with pytest.raises(InvalidInput, match=r"line 2: key .* twice"):
        read_keys(path)


@pytest.mark.parametrize("mode", [0o620, 0o602, 0o666])
def test_a_file_that_others_may_write_is_refused(path, key, mode):
    write(path, line_of(key), mode)
    with pytest.raises(InvalidInput, match="chmod go-w"):
        KeyRing(path)
    with pytest.raises(InvalidInput, match="chmod go-w"):
        add_key(path, make_key("bob", [Scope.READ])[0])


def test_a_file_that_is_missing_is_said_with_what_makes_one(path):
    with pytest.raises(InvalidInput, match="motionlabel key new"):
        KeyRing(path)


def test_scopes_hold_those_before_them():
    assert {scope: [other for other in Scope if scope.holds(other)] for scope in Scope} == {
        Scope.READ: [Scope.READ],
        Scope.SUBMIT: [Scope.READ, Scope.SUBMIT],
        Scope.ADMIN: list(Scope),
    }


def test_a_key_ends_at_its_moment(path):
    key, token = make_key("ann", [Scope.READ], expires=NOW)
    add_key(path, key)
    ring = KeyRing(path)
    assert ring.find(token, NOW - timedelta(microseconds=1)) == key
    assert ring.find(token, NOW) is None
    assert ring.get(key.id, NOW) is None


def test_keys_rotate_without_a_restart(path):
    old, old_token = make_key("ann", [Scope.READ])
    new, new_token = make_key("ann", [Scope.READ])
    add_key(path, old)
    ring = KeyRing(path)
    assert (ring.find(old_token), ring.find(new_token)) == (old, None)
    add_key(path, new)
    assert (ring.find(old_token), ring.find(new_token)) == (old, new)
    revoke_key(path, old.id)
    assert (ring.find(old_token), ring.find(new_token)) == (None, new)


def test_a_file_that_did_not_change_is_not_read_again(path, key, monkeypatch):
    add_key(path, key)
    ring = KeyRing(path)
    monkeypatch.setattr("service.keys.read_keys", lambda _: pytest.fail("read again"))
    assert [ring.get(key.id) for _ in range(3)] == [key] * 3


@pytest.mark.parametrize("damage", ["broken", "writable", "gone"])
def test_a_file_that_breaks_leaves_the_keys_and_is_said_once(path, caplog, damage):
    key, token = make_key("ann", [Scope.READ])
    add_key(path, key)
    ring = KeyRing(path)
    text = path.read_text()
    match damage:
        case "broken":
            write(path, text + '{"id": ')
        case "writable":
            path.chmod(0o666)
        case "gone":
            path.unlink()
    assert [ring.find(token) for _ in range(3)] == [key] * 3
    assert ring.find(make_key("bob", [Scope.ADMIN])[1]) is None
    assert ["stay in use" in record.message for record in caplog.records] == [True]
    write(path, text + line_of(make_key("bob", [Scope.READ])[0]))
    assert [ring.find(token) for _ in range(3)] == [key] * 3
    assert caplog.messages[1:] == ["the API keys can be read again"]
    assert token not in caplog.text


def test_an_empty_file_lets_nobody_in(path):
    key, token = make_key("ann", [Scope.READ])
    add_key(path, key)
    ring = KeyRing(path)
    write(path, "")
    assert ring.find(token) is None


def test_tokens_are_compared_in_constant_time_also_where_there_is_no_such_key(path, monkeypatch):
    key, token = make_key("ann", [Scope.READ])
    add_key(path, key)
    ring = KeyRing(path)
    compared = []

    def note(left, right):
        compared.append((len(left), len(right)))
        return compare(left, right)

    compare = hmac.compare_digest
    monkeypatch.setattr(hmac, "compare_digest", note)
    for given in (token, token[:-1] + "!", make_key("bob", [Scope.READ])[1], "", "x"):
        ring.find(given)
    assert compared == [(64, 64)] * 5


COMMANDS = ["--owner", "ann", "--scope", "submit"]


@pytest.fixture
def key_command(cli, path):
    return lambda *arguments: cli("key", *arguments, "--file", path)


def test_the_command_makes_a_key_that_works_and_shows_its_token_once(key_command, path):
    code, out, err = key_command("new", *COMMANDS, "--expires", "2100-01-31", "--root", "/data/ann")
    assert code == 0
    token = out.strip()
    found = KeyRing(path).find(token)
    assert (found.owner, found.scopes, found.roots) == ("ann", (Scope.SUBMIT,), ("/data/ann",))
    assert found.expires == datetime(2100, 1, 31, tzinfo=UTC)
    assert [token in line for line in err] == [False]
    code, out, err = key_command("list")
    assert (code, err) == (0, [])
    assert out == f"{found.id} ann submit until 2100-01-31 00:00 UTC, below /data/ann\n"
    assert key_command("revoke", found.id) == (0, "", [])
    assert key_command("list") == (0, "", [])


def test_a_key_reads_only_unless_more_is_asked_for(key_command, path):
    key_command("new", "--owner", "ann", "--expires", "2000-01-01T12:00+02:00")
    (found,) = read_keys(path)
    assert found.scopes == (Scope.READ,)
    assert key_command("list")[1] == f"{found.id} ann read until 2000-01-01 10:00 UTC (over)\n"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["new", "--owner", "a b"], "owner of a key"),
        (["new", "--owner", ""], "owner of a key"),
        (["new", "--owner", "ann", "--expires", "soon"], "--expires soon: expected a date"),
        (["new", "--owner", "ann", "--scope", "root"], "'root' is not one of"),
        (["revoke", "0a0a0a0a"], "no key of this id"),
    ],
)
def test_a_wrong_command_is_one_line_and_changes_nothing(key_command, path, arguments, reason):
    code, out, err = key_command(*arguments)
    assert (code, out, len(err)) == (2, "", 1)
    assert reason in err[0]
    assert not path.exists()


def test_the_file_comes_from_the_environment_too(cli, path, monkeypatch):
    code, out, err = cli("key", "list")
    assert (code, out) == (2, "")
    assert "MOTIONLABEL_API_KEYS_FILE" in err[0]
    monkeypatch.setenv("MOTIONLABEL_API_KEYS_FILE", str(path))
    assert cli("key", "new", *COMMANDS)[0] == 0
    assert len(read_keys(path)) == 1


def test_a_folder_that_is_missing_is_one_line(cli, tmp_path):
    code, out, err = cli("key", "new", *COMMANDS, "--file", tmp_path / "none" / "keys")
    assert (code, out, len(err)) == (2, "", 1)
    assert "No such file or directory" in err[0]
