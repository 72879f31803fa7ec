from pathlib import Path

import pytest

from schemas.errors import InvalidInput
from service.settings import Settings, describe_settings, read_settings


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_nothing_set_is_enough(tmp_path):
    settings = read_settings()
    assert settings.host == "127.0.0.1"
    assert settings.data_roots == (str(tmp_path),)
    assert settings.store_url == f"sqlite:///{tmp_path}/motionlabel-data/jobs.sqlite3"


def test_the_environment_is_read_and_options_win(tmp_path, monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_PORT", "9000")
    monkeypatch.setenv("MOTIONLABEL_HOST", "::1")
    monkeypatch.setenv("MOTIONLABEL_DATA_DIR", "data")
    settings = read_settings(port=9001, host=None)
    assert (settings.port, settings.host, settings.data_dir) == (9001, "::1", tmp_path / "data")


def test_an_empty_variable_is_no_variable(monkeypatch):
    monkeypatch.setenv("MOTIONLABEL_PORT", "")
    assert read_settings().port == 8000


def test_data_roots_are_a_list_by_their_canonical_names(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    monkeypatch.setenv("MOTIONLABEL_DATA_ROOTS", "link, s3://bucket/logs/ ,/data/../data")
    assert read_settings().data_roots == (str(tmp_path / "real"), "s3://bucket/logs", str(Path("/data").resolve()))


@pytest.mark.parametrize(
    ("name", "value"), [("PORT", "http"), ("PORT", "65536"), ("DATA_ROOTS", "s3://bucket/../other")]
)
def test_a_wrong_variable_is_named(monkeypatch, name, value):
    monkeypatch.setenv(f"MOTIONLABEL_{name}", value)
    with pytest.raises(InvalidInput, match=f"^MOTIONLABEL_{name}="):
        read_settings()


def test_a_wrong_option_is_named(monkeypatch):
    with pytest.raises(InvalidInput, match=r"^--port=-1: "):
        read_settings(port=-1)


def test_the_description_names_every_variable():
    text = describe_settings()
    assert all(f"MOTIONLABEL_{name.upper()}: " in text for name in Settings.model_fields)
    assert "None" not in text
