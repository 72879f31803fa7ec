"""`motionlabel ablate flow` and `motionlabel ablate boxes`: what each part of the method buys, as tables."""

from pathlib import Path
from typing import Annotated, Final

import typer

from labeling.readers.reader import open_segment
from schemas.config import resolve_config
from schemas.errors import InvalidInput
from service.options import (
    Dataset,
    Overrides,
    Profile,
    Segments,
    Sweeps,
    parse_overrides,
    parse_sweeps,
    require_folder_of,
)
from service.progress import progress_bar

HELP: Final = "Judge the method with parts of it left out. Needs segments with annotations."

app = typer.Typer(help=HELP, rich_markup_mode=None)

Figures = Annotated[Path | None, typer.Option("--output", metavar="FILE", help="Also write the figures as JSON.")]
Azimuth = Annotated[
    float | None,
    typer.Option(metavar="DEG", help="Only within this angle of straight ahead, for logs annotated there only."),
]


@app.command(epilog="Example: motionlabel ablate flow logs/0a1b logs/2c3d --dataset av2 --rows zero,rigid,default")
def flow(
    segments: Segments,
    dataset: Dataset,
    rows: Annotated[
        str | None,
        typer.Option(
            metavar="ROW,...",
            help="Only these of zero,nsfp,no-box-query,expansion,pruning,paper,rigid,default. Minutes to an hour a "
            "sweep: nsfp and the four of the paper; seconds: the others.",
        ),
    ] = None,
    sweeps: Annotated[
        str | None, typer.Option(metavar="N,...", help="Indices of the sweeps, as 2,12,25; by default four a log.")
    ] = None,
    overrides: Overrides = None,
    azimuth_deg: Azimuth = None,
    output: Figures = None,
) -> None:
    """Compare the flow of the paper's variants, NSFP, rigid motion and the default on the same sweeps."""
    from labeling.evaluation.flow_ablation import ablate_flow, choose_flow_rows, render_flow_ablation

    _check(azimuth_deg, output)
    indices = None if sweeps is None else _parse_indices(sweeps)
    chosen = choose_flow_rows(None if rows is None else rows.split(","))
    readers = [open_segment(dataset, segment) for segment in segments]
    with progress_bar() as bar:
        task = bar.add_task("observing", total=None)
        ablation = ablate_flow(
            readers,
            chosen,
            changes=parse_overrides(overrides or []),
            sweeps=indices,
            azimuth_deg=azimuth_deg,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    typer.echo(render_flow_ablation(ablation), nl=False)
    if output is not None:
        output.write_text(ablation.model_dump_json(indent=2) + "\n")


@app.command(epilog="Example: motionlabel ablate boxes logs/0a1b logs/2c3d --dataset av2 --output out/boxes.json")
def boxes(
    segments: Segments,
    dataset: Dataset,
    rows: Annotated[
        str | None,
        typer.Option(
            metavar="ROW,...",
            help="Only these of no-flow-clustering,no-flow-full,flow-clustering,full,oracle-clustering,oracle-full,"
            "position-clustering,no-start,rotation-start,grid-start,both-starts,unconstrained.",
        ),
    ] = None,
    sweeps: Sweeps = None,
    profile: Profile = "default",
    overrides: Overrides = None,
    azimuth_deg: Azimuth = None,
    output: Figures = None,
) -> None:
    """Compare boxes without flow, with ours and with an oracle's; clusters and full pipeline; ways of registration."""
    from labeling.evaluation.box_ablation import ablate_boxes, choose_box_rows, render_box_ablation

    _check(azimuth_deg, output)
    changes = parse_overrides(overrides or [])
    if sweeps is not None:
        changes["sweeps"] = parse_sweeps(sweeps)
    chosen = choose_box_rows(None if rows is None else rows.split(","))
    flow_folder = resolve_config(profile, changes).flow.external_folder
    readers = [open_segment(dataset, segment, flow_folder) for segment in segments]
    with progress_bar() as bar:
        task = bar.add_task("labelling", total=None)
        ablation = ablate_boxes(
            readers,
            chosen,
            profile=profile,
            changes=changes,
            azimuth_deg=azimuth_deg,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    typer.echo(render_box_ablation(ablation), nl=False)
    if output is not None:
        output.write_text(ablation.model_dump_json(indent=2) + "\n")


def _check(azimuth_deg: float | None, output: Path | None) -> None:
    """Refuse what would fail after the work."""
    if azimuth_deg is not None and not 0 < azimuth_deg <= 180:
        raise InvalidInput(f"--azimuth-deg {azimuth_deg:g}: expected degrees above 0 and up to 180")
    require_folder_of("--output", output)


def _parse_indices(text: str) -> list[int]:
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise InvalidInput(f"--sweeps {text}: expected indices, as --sweeps 2,12,25")
    return [int(part) for part in parts]
