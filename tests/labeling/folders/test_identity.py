from labeling.folders.identity import code_version, make_identity, shard_paths
from schemas.config import LabelingConfig, resolve_config


def test_identity_follows_segments_config_and_code(monkeypatch):
    config = LabelingConfig()
    identity = make_identity(["a", "b"], config)
    assert len(identity) == 16
    assert int(identity, 16) >= 0
    assert identity == make_identity(["b", "a"], config)  # a set, in whatever order it was given
    assert identity != make_identity(["a"], config)
    assert identity != make_identity(["ab"], config)
    assert identity != make_identity(["a", "b"], resolve_config(overrides={"flow.iterations": 61}))
    monkeypatch.setattr("labeling.folders.identity.code_version", lambda: "other")
    assert identity != make_identity(["a", "b"], config)


def test_code_version_names_the_package_and_its_source():
    package, digest = code_version().split("+")
    assert package.count(".") == 2
    assert len(digest) == 12


def test_points_have_a_shard_only_when_asked():
    assert set(shard_paths("s", LabelingConfig())) == {"labels", "sweeps"}
    paths = shard_paths("s", LabelingConfig(write_points=True))
    assert set(paths) == {"labels", "sweeps", "points"}
    assert all(path.startswith(f"{table}/s-") and path.endswith(".parquet") for table, path in paths.items())
