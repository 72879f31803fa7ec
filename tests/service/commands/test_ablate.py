import json

import pytest

from labeling.evaluation.flow_ablation import FLOW_ROWS

STREET = "synthetic:street?sweeps=4&beams=16&azimuth_steps=360"


@pytest.fixture
def ablate_flow(cli):
    def run(*arguments, log=STREET, dataset="synthetic"):
        return cli("ablate", "flow", log, "--dataset", dataset, *arguments)

    return run


def test_help_names_the_rows_and_an_example(cli):
    code, out, _ = cli("ablate", "flow", "--help")
    assert code == 0
    assert "Example: motionlabel ablate flow" in out
    assert ",".join(row.key for row in FLOW_ROWS) in out.replace("\n", "").replace(" ", "")


def test_flow_writes_tables_and_figures(ablate_flow, tmp_path):
    changes = ["--set", "flow.iterations=1", "--set", "static.vote_gaps_s=[0.2]"]
    code, out, err = ablate_flow(
        "--rows", "zero,default", "--sweeps", "1,2", *changes, "--output", tmp_path / "flow.json"
    )
    assert (code, err) == (0, [])
    for text in ("**Scene flow**", "\n| zero flow ", "\n| default ", "**Static points removed**", "visibility"):
        assert text in out
    figures = json.loads((tmp_path / "flow.json").read_text())
    assert [row["key"] for row in figures["rows"]] == ["zero", "default"]
    assert figures["logs"][0]["sweeps"] == [1, 2]
    assert figures["rows"][1]["config"]["flow"]["iterations"] == 1
    assert figures["rows"][1]["flow"]["num_sweeps"] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rows", "zero,magic"], "unknown row 'magic': expected some of zero, nsfp, "),
        (["--sweeps", "1,x"], "--sweeps 1,x: expected indices, as --sweeps 2,12,25"),
        (["--sweeps", "9"], "sweep 9 lies outside synthetic:street"),
        (["--sweeps", "3"], "sweep 3 of synthetic:street"),
        (["--set", "flow.nope=1"], "unknown option flow.nope"),
        (["--azimuth-deg", "0"], "--azimuth-deg 0: expected degrees above 0 and up to 180"),
        (["--output", "nowhere/flow.json"], "--output nowhere/flow.json: no folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_input_is_one_line(ablate_flow, arguments, message):
    code, out, err = ablate_flow(*arguments)
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]


def test_an_unknown_log_is_one_line(ablate_flow, tmp_path):
    code, out, err = ablate_flow(log=tmp_path / "absent", dataset="av2")
    assert (code, out, len(err)) == (2, "", 1)
    assert "absent" in err[0]
