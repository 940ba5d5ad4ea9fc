"""`beers-deploy tradeoff`: what accuracy costs in time, over many operating points."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands.shared import refuse, say
from model.processor import SEEDS
from model.shipped import SENSOR
from profiles.target import DEFAULT_TARGET, board_names

if TYPE_CHECKING:
    from collections.abc import Sequence

    from deploy.tradeoff.points import Demand
    from deploy.tradeoff.study import Study

EXAMPLE = "tradeoff --images aerial/ --out study/ --budget 'latency<=20s'"
PAPER_SIZE = "13600x9016"
BOARDS = ", ".join(board_names())
SHOWN = ("PSNR", "LPIPS-squeeze", "mAP50", "host p50", "board latency", "board energy")
"""Figures on the terminal; the report and the document hold all."""


def tradeoff(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder for the report, tradeoff.json and the cache of measurements.")],
    images: Annotated[
        Path | None, typer.Option(help="Folder of held-out scenes to simulate from; drawn ones if none.")
    ] = None,
    sensor: Annotated[str, typer.Option(help="Profile of the degraded images.")] = SENSOR,
    reference: Annotated[
        str | None,
        typer.Option(help="Profile of the reference images, in the sensor's DN; pleiades-reference if none."),
    ] = None,
    networks: Annotated[
        str | None,
        typer.Option(help="Shipped names and ONNX or safetensors files, with commas; all shipped ones if none."),
    ] = None,
    network: Annotated[
        list[Path] | None,
        typer.Option(
            help="Your own network beside them: float ONNX or safetensors, made INT8 as the shipped ones are, or an "
            "INT8 file as it is. The board's DPU must run it; may be given again."
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(help="Method that all are held against, image by image; the best traditional chain if none."),
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="What you can afford: 'latency<=20s', 'energy<=600J,host<=2'. Best PSNR wins.")
    ] = None,
    need: Annotated[
        str | None, typer.Option(help="What you must reach: 'psnr>=44'. Without a budget the least latency wins.")
    ] = None,
    lpips: Annotated[
        Path | None, typer.Option(help="Weights of SqueezeNet 1.1 for LPIPS-squeeze, or a folder of backbones.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Folder of scenes to make missing INT8 files on; drawn ones if none.")
    ] = None,
    labelled: Annotated[
        Path | None,
        typer.Option(help="Folder of labelled pictures, as detect reads them: what a detector finds is a quality."),
    ] = None,
    detector: Annotated[
        Path | None, typer.Option(help="ONNX as Ultralytics exports it; the embedded one if none.")
    ] = None,
    classes: Annotated[
        str | None, typer.Option(help="Labelled classes under the detector's names: car=vehicle,minibus=vehicle.")
    ] = None,
    target: Annotated[
        str,
        typer.Option(
            help=f"The modelled board: {BOARDS}, or your .toml file; several with commas, or 'all': the first is the "
            "study's, on the others its networks are compared."
        ),
    ] = DEFAULT_TARGET,
    size: Annotated[str, typer.Option(help="Width x height of the swath in pixels.")] = PAPER_SIZE,
    cache: Annotated[Path | None, typer.Option(help="Folder of kept measurements; OUT/cache if none.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of every random draw.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here too.")] = None,
) -> None:
    """Measure networks, chains and peers on the same pairs, predict their runs on the board, and weigh them.

    Measurements are kept: a second run, or one that was stopped, measures only what is missing. Exit code 1 where no
    point keeps --budget and --need; the report is written all the same.
    """
    from deploy.bench.tables import parse_size
    from deploy.cache import Cache
    from deploy.detection.classes import parse_classes
    from deploy.results import Document
    from deploy.tradeoff.boards import parse_targets
    from deploy.tradeoff.detection import Request as DetectionRequest
    from deploy.tradeoff.page import FILES, write_study
    from deploy.tradeoff.points import parse_demands
    from deploy.tradeoff.run import run_study
    from deploy.tradeoff.selection import Request
    from model.io.files import require_writable
    from model.shipped import shipped_names
    from profiles.sensor_file import REFERENCE, load_sensor, reference_beside

    figures, kept = out / "tradeoff.json", cache or out / "cache"
    demands = [tuple(parse_demands(name, text)) for name, text in (("--budget", budget), ("--need", need))]
    if labelled is None:
        _refuse_unlabelled(context, *demands)
    own = tuple(map(str, network or ()))
    names = (*(networks.split(",") if networks is not None else shipped_names()), *own)
    aim = reference or REFERENCE
    boards = parse_targets(target)
    tree = labelled.rglob("*") if labelled else ()
    read = (images, calibration, lpips, labelled, detector, *tree, *map(Path, (sensor, aim, *boards, *names)))
    require_writable(figures, *(out / name for name in FILES), json, inputs=read, folders=(kept,))
    reference_beside(load_sensor(sensor), reference, say)
    looked = DetectionRequest(labelled, detector, parse_classes(classes) if classes else {}) if labelled else None
    request = Request(
        names,
        images,
        calibration,
        sensor,
        aim,
        lpips,
        parse_size(size),
        demands[0],
        demands[1],
        seed,
        boards[0],
        boards,
        looked,
        own,
        against,
    )
    result = run_study(request, Cache(kept), partial(say, err=True))
    write_study(result.study, out)
    show(result.study)
    arguments: dict[str, object] = {"images": images, "sensor": sensor, "reference": aim, "size": size}
    arguments |= {"networks": networks, "budget": budget, "need": need, "calibration": calibration, "seed": seed}
    arguments |= {"target": target, "network": ",".join(own) or None, "against": against}
    if labelled:
        arguments |= {"labelled": labelled, "detector": detector, "classes": classes}
    document = Document("tradeoff", arguments, (*request.files, *result.labelled), result.rows)
    for path in (figures, json):
        document.write(path)
    if not result.met:
        raise typer.Exit(1)


def _refuse_unlabelled(context: typer.Context, *demands: "Sequence[Demand]") -> None:
    """Refuse what only labelled pictures have: a detector, its classes, and demands on what it finds."""
    from deploy.tradeoff.points import MAP50

    expected, got = "--labelled beside it", "none"
    refuse(context, ["detector", "classes"], expected=expected, got=got, remedy="leave it out")
    for option, asked in zip(("budget", "need"), demands, strict=True):
        if any(demand.key == MAP50 for demand in asked):
            refuse(context, [option], expected=f"{expected} for {MAP50}", got=got, remedy="give labelled pictures")


def show(study: "Study") -> None:
    """The most important figures, and what they mean."""
    from deploy.results import print_rows
    from profiles.figures import Row

    rows = [
        Row(r.table, r.name, {key: r.figures[key] for key in SHOWN if key in r.figures}, {"sensor": r.text["sensor"]})
        for r in study.points
    ]
    print_rows("operating points", rows)
    for front in study.fronts:
        if front.y in ("PSNR", "mAP50"):
            say(f"front of {front.y} against {front.x}: {'; '.join(front.members)}")
            for sentence in (*front.prices, *front.alike):
                say(f"  {sentence}")
    own = [row for row in study.recommended if row.text["board"] == study.recommended[0].text["board"]]
    others = [f"{row.name}: {row.text['sentence']}" for row in own[1:]]
    for sentence in (*study.advice, *others, study.headline):
        say(sentence)
