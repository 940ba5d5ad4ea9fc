"""`beers-deploy tradeoff`: what accuracy costs in time, over many operating points."""

from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import (
    Classes,
    Detector,
    Json,
    Lpips,
    Reference,
    Seed,
    refuse,
    save,
    say,
)
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.sensor_file import REFERENCE, load_sensor, reference_beside
from beers_deploy.profiles.target import DEFAULT_TARGET, board_names

PAPER_SIZE = "13600x9016"
BOARDS = ", ".join(board_names())


def tradeoff(
    context: typer.Context,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder of page, figures and measurements.")
    ],
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of held-out scenes to simulate from; drawn ones if none."),
    ] = None,
    sensor: Annotated[str, typer.Option(help="Profile of the degraded images.")] = SENSOR,
    reference: Reference = None,
    network: Annotated[
        list[str] | None,
        typer.Option(
            help="A shipped name, float ONNX or safetensors, quantised on the way, or an INT8 "
            "file as it is; may be "
            "given again, and 'all' stands for the shipped ones, as if none is given."
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option(
            help="What you can afford: 'latency<=20s', 'latency<=9s,power<=20W'. Best PSNR wins."
        ),
    ] = None,
    need: Annotated[
        str | None,
        typer.Option(
            help="What you must reach: 'psnr>=44'. Without a budget the least latency wins."
        ),
    ] = None,
    lpips: Lpips = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Folder of scenes to quantise your networks on; drawn ones if none."),
    ] = None,
    labelled: Annotated[
        Path | None,
        typer.Option(
            help="Folder of labelled pictures, as detect reads them: what a detector finds is a "
            "figure too."
        ),
    ] = None,
    detector: Detector = None,
    classes: Classes = None,
    target: Annotated[
        str,
        typer.Option(
            help=f"The modelled board: {BOARDS}, or your .toml file; several with commas, or "
            "'all'. Several are "
            "compared, and one is recommended."
        ),
    ] = DEFAULT_TARGET,
    size: Annotated[str, typer.Option(help="Width x height of the swath in pixels.")] = PAPER_SIZE,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Measure networks and pipelines on the same images, predict board runs, recommend a point.

    All boards of --target are compared, whatever their order; for each that is not recommended a
    line says why. Measurements are kept: a second run, or one that was stopped, measures only what
    is missing. Exit code 1 where no point keeps --budget and --need; the page is written all the
    same.
    """
    from beers_deploy.dpu.board import ALL
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.shipped import shipped_names
    from beers_deploy.results import print_rows
    from beers_deploy.studies.tradeoff.advice import MAP50, parse_constraints
    from beers_deploy.studies.tradeoff.page import FILES
    from beers_deploy.studies.tradeoff.points import parse_targets
    from beers_deploy.studies.tradeoff.run import tradeoff as measured

    log = partial(say, err=True)
    limits = {
        name: parse_constraints(name, text) for name, text in (("budget", budget), ("need", need))
    }
    # Only a detector on labelled pictures gives a mean average precision.
    if labelled is None:
        constraint_options = [
            name
            for name, constraints in limits.items()
            if any(constraint.key == MAP50 for constraint in constraints)
        ]
        remedy = "give labelled pictures, or leave it out"
        refuse(
            context,
            ["detector", "classes", *constraint_options],
            expected="--labelled beside it",
            remedy=remedy,
        )
    groups = (shipped_names() if name == ALL else [name] for name in network or [ALL])
    names = list(chain.from_iterable(groups))
    aim = reference or REFERENCE
    boards = parse_targets(target)
    tree = labelled.rglob("*") if labelled else ()
    inputs = (
        images,
        calibration,
        lpips,
        labelled,
        detector,
        *tree,
        *map(Path, (sensor, aim, *boards, *names)),
    )
    outputs = (
        out / "tradeoff.json",
        *(out / name for name in FILES),
        out / "measurements.json",
        json,
    )
    require_writable(*outputs, inputs=inputs, folders=(out / "int8",))
    # A reference in other digital numbers is converted, which is said before the study runs.
    reference_beside(load_sensor(sensor), reference, say)
    study = measured(
        names,
        images=images,
        sensor=sensor,
        reference=aim,
        board=boards,
        size=size,
        budget=budget,
        need=need,
        lpips=lpips,
        calibration=calibration,
        labelled=labelled,
        detector=detector,
        classes=classes,
        seed=seed,
        cache=out,
        log=log,
    )
    study.report(out)
    print_rows(f"front of PSNR against {study.cost}", study.front_rows)
    for line in study.lines:
        say(line)
    for path in (out / "tradeoff.json", json):
        save(study, path)
    say(f"wrote {out / FILES[0]}")
    if study.best is None:
        raise typer.Exit(1)
