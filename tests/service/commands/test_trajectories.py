import pyarrow.parquet as pq


def test_trajectories_are_written_by_command(cli, label, write_log, fast_stages, tmp_path):
    assert label(write_log())[0] == 0
    output = tmp_path / "trajectories"
    arguments = ["trajectories", tmp_path / "out", "--output", output]
    code, said, err = cli(*arguments, "--step-s", 0.2)
    assert (code, err) == (0, [])
    (path,) = output.iterdir()
    assert len(pq.read_table(path)) == 3
    assert said == (
        f"{output}: windows: 3, tracks: 1, gaps that are not bridged: 0, segments: 1; files: 1 written, "
        "0 already there\n"
    )
    assert cli(*arguments, "--step-s", 0.2)[1] == said.replace("1 written, 0 already", "0 written, 1 already")
    code, said, (line,) = cli(*arguments)
    assert (code, said) == (2, "")
    assert "is there with other content" in line


def test_scenarios_are_written_by_command(cli, label, write_log, fast_stages, tmp_path):
    label(write_log())
    code, said, err = cli("trajectories", tmp_path / "out", "--output", tmp_path / "s", "--format", "scenarionet")
    assert (code, err) == (0, [])
    assert "scenarios: 1, tracks: 1" in said
    assert "files: 3 written" in said


def test_a_segment_that_failed_is_named(cli, label, write_log, fast_stages, tmp_path):
    assert label(write_log(), tmp_path / "lost")[0] == 3
    code, said, (line,) = cli("trajectories", tmp_path / "out", "--output", tmp_path / "trajectories")
    assert code == 3
    assert "segments: 1; files: 1 written" in said
    assert line.startswith("motionlabel: lost-")


def test_bad_input_is_one_line(cli, tmp_path):
    for arguments, message in [
        (["--output", "x"], f"no labels at {tmp_path}: expected manifests/*.json"),
        (["--output", ""], "--output is empty"),
        (["--output", "x", "--format", "csv"], "unknown format 'csv': expected one of parquet, scenarionet"),
        (["--output", "x", "--hz", "0"], "--hz 0: expected 0.1 to 100"),
        (["--output", "x", "--format", "scenarionet", "--future-s", "3"], "--future-s means nothing to format"),
    ]:
        code, said, (line,) = cli("trajectories", tmp_path, *arguments)
        assert (code, said) == (2, "")
        assert message in line
