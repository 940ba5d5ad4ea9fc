"""`beers-deploy detect`: what restoration buys a detector."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import (
    Classes,
    Detector,
    Json,
    Reference,
    Seed,
    arguments,
    refuse,
    save,
    say,
)
from beers_deploy.profiles.figures import by_table

SENSORS = "dior-medium,dior-high"
REPORT = "report.html"
METHODS = "traditional,convbeers-s,convbeers-s-int8"
DRAWN = 24


def detect(
    context: typer.Context,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of labelled pictures, DIOR's among them; synthetic scenes if none."
        ),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            help="Folder of their labels (VOC, YOLO) or COCO's .json; beside them if none."
        ),
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="Pictures that a list of the folder names, such as test.")
    ] = None,
    detector: Detector = None,
    sensor: Annotated[
        str, typer.Option(help="Profiles of the degraded images, names or .toml files with commas.")
    ] = SENSORS,
    reference: Reference = None,
    methods: Annotated[
        str, typer.Option(help="Names, with commas; degraded is always a row.")
    ] = METHODS,
    side: Annotated[
        int | None,
        typer.Option(
            min=32, max=4096, help="Side of the detector's input, where its file leaves it open."
        ),
    ] = None,
    classes: Classes = None,
    drawn: Annotated[
        int, typer.Option(min=2, max=10_000, help="Synthetic scenes, without --images.")
    ] = DRAWN,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for report.html.")] = Path(
        "detection"
    ),
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Score what a detector finds in scenes as the reference sees them, degraded and restored.

    Average precision, precision and recall with intervals over sites, and the share of the loss
    that restoration regains. The detector is fixed, as one in service is.
    """
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.shipped import DETECTOR
    from beers_deploy.results import Table, print_rows
    from beers_deploy.studies.detection.average_precision import sites_note
    from beers_deploy.studies.detection.detector import open_detector, parse_classes
    from beers_deploy.studies.detection.page import write_page
    from beers_deploy.studies.detection.study import labelled_scenes, run_study, synthetic_scenes
    from beers_deploy.studies.detection.tables import (
        MAIN,
        PAPER_TABLE,
        detection_rows,
        headline,
        paper_rows,
    )

    if images is None:
        refuse(context, ["labels", "split"], expected="--images beside it")
    else:
        refuse(context, ["drawn"], expected="synthetic scenes", got="--images beside it")
    # A name that is given twice is measured once, in the order of the command line.
    names = list(dict.fromkeys(["degraded", *(name.strip() for name in methods.split(","))]))
    sensors = list(dict.fromkeys(name.strip() for name in sensor.split(",")))
    # No output may replace a picture or a label, wherever in the folders it lies.
    trees = [tree.rglob("*") for tree in (images, labels) if tree is not None and tree.is_dir()]
    paths = [Path(name) for name in (*sensors, *names, reference) if name]
    inputs = (images, labels, detector, *chain.from_iterable(trees), *paths)
    require_writable(out / REPORT, json, inputs=inputs, folders=(out,))
    network = open_detector(detector or DETECTOR, size_px=side)
    class_names = {} if classes is None else parse_classes(classes)
    if images is None:
        scenes, notes = synthetic_scenes(drawn, seed, network.names, class_names)
    else:
        scenes, notes = labelled_scenes(network.names, class_names, images, labels, split)
    compared = run_study(network, scenes, sensors, names, reference=reference, seed=seed, say=say)
    notes = [note for note in (network.flag, sites_note(compared[0].sites), *notes) if note]
    rows = [*chain.from_iterable(map(detection_rows, compared)), *paper_rows()]
    for table, part in by_table(rows).items():
        if table.startswith((MAIN, PAPER_TABLE)):
            print_rows(table, part)
    for sentence in (*notes, headline(compared)):
        say(sentence)
    write_page(compared, rows, notes, out / REPORT)
    say(f"wrote {out / REPORT}")
    pictures = [scene.path for scene in scenes if scene.path is not None]
    save(Table("detect", arguments(), (detector or DETECTOR, *pictures), tuple(rows)), json)
