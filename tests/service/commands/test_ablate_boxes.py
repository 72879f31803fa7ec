import json

import pytest

from labeling.evaluation.box_ablation import BOX_ROW_KEYS

STREET = "synthetic:street?sweeps=5&beams=16&azimuth_steps=360"


@pytest.fixture
def ablate_boxes(cli):
    def run(*arguments):
        return cli("ablate", "boxes", STREET, "--dataset", "synthetic", "--profile", "fast", *arguments)

    return run


def test_help_names_the_rows_and_an_example(cli):
    code, out, _ = cli("ablate", "boxes", "--help")
    assert code == 0
    assert "Example: motionlabel ablate boxes" in out
    assert ",".join(BOX_ROW_KEYS) in out.replace("\n", "").replace(" ", "")


def test_boxes_writes_tables_and_figures(ablate_boxes, tmp_path):
    rows = "oracle-full,no-flow-clustering"
    changes = ["--set", "static.vote_gaps_s=[0.2]", "--sweeps", "1:4"]
    code, out, err = ablate_boxes("--rows", rows, *changes, "--output", tmp_path / "boxes.json")
    assert (code, err) == (0, [])
    for text in ("1 log, 3 sweeps", "**Flow and pipeline**", "\n| no flow + clustering ", "\n| oracle flow + full"):
        assert text in out
    assert "Registration" not in out
    figures = json.loads((tmp_path / "boxes.json").read_text())
    assert [row["key"] for row in figures["rows"]] == ["no-flow-clustering", "oracle-full"]
    assert figures["config"]["static"]["vote_gaps_s"] == [0.2]
    assert figures["config"]["sweeps"] == [1, 4]
    assert figures["rows"][1]["box_figures"]["num_sweeps"] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rows", "full,magic"], "unknown row 'magic': expected some of no-flow-clustering, "),
        (["--sweeps", "1"], "--sweeps 1: expected START:STOP"),
        (["--sweeps", "1:9"], "sweeps 1:9 lie outside synthetic:street"),
        (["--set", "flow.method=none"], "flow.method=none is what some rows change"),
        (["--set", "registration.nope=1"], "unknown option registration.nope"),
        (["--profile", "slow"], "unknown profile 'slow'"),
        (["--azimuth-deg", "181"], "--azimuth-deg 181: expected degrees above 0 and up to 180"),
        (["--output", "nowhere/boxes.json"], "--output nowhere/boxes.json: no folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_input_is_one_line(ablate_boxes, arguments, message):
    code, out, err = ablate_boxes(*arguments)
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]
