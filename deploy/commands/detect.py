"""`beers-deploy detect`: what restoration buys a detector."""

from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands.shared import refuse, say
from model.processor import SEEDS

if TYPE_CHECKING:
    from deploy.detection.run import DetectionRun

EXAMPLE = "detect --images DIOR/ --split test --detector yolo11n.onnx --sensor dior-medium --out detection/"
SENSORS = "dior-medium,dior-high"
METHODS = "traditional,convbeers-s,convbeers-s-int8"
DRAWN = 24


def detect(
    context: typer.Context,
    images: Annotated[
        Path | None, typer.Option(help="Folder of labelled pictures, DIOR's among them; drawn scenes if none.")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(help="Folder of their labels (VOC, YOLO) or COCO's .json; beside them if none.")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Pictures that a list of the folder names, such as test.")] = None,
    detector: Annotated[
        Path | None, typer.Option(help="ONNX as Ultralytics exports it; the embedded one if none.")
    ] = None,
    sensor: Annotated[
        str, typer.Option(help="Profiles of the degraded images, names or .toml files with commas.")
    ] = SENSORS,
    reference: Annotated[
        str | None,
        typer.Option(help="Profile of the reference images, in the sensor's DN; pleiades-reference if none."),
    ] = None,
    methods: Annotated[str, typer.Option(help="Names, with commas; degraded is always a row.")] = METHODS,
    size: Annotated[
        int | None,
        typer.Option(min=32, max=4096, help="Side of the detector's input, where its file leaves it open."),
    ] = None,
    classes: Annotated[
        str | None, typer.Option(help="Labelled classes under the detector's names: car=vehicle,minibus=vehicle.")
    ] = None,
    drawn: Annotated[int, typer.Option(min=2, max=10_000, help="Scenes to draw, without --images.")] = DRAWN,
    retrain: Annotated[
        bool, typer.Option("--retrain", help="Train the embedded detector for each row anew, as the paper does.")
    ] = False,
    out: Annotated[
        Path, typer.Option(help="Folder for report.html and a cache of what was found: a stopped run goes on.")
    ] = Path("detection"),
    seed: Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of every random draw.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Show a detector the same scenes as the reference sees them, degraded and restored, and score what it finds.

    Average precision, precision and recall with intervals over sites, and the share of the loss that restoration
    regains. The detector is fixed, as one in service is. With --retrain it is trained for each row on that row's own
    pictures, three times from other seeds: the paper's protocol, another question.
    """
    from deploy.cache import Cache
    from deploy.detection.classes import parse_classes
    from deploy.detection.run import REPORT, DetectionRequest, run_detection
    from deploy.results import Document
    from model.io.files import require_writable

    _refuse_unused(context)
    names = list(dict.fromkeys(["degraded", *(name.strip() for name in methods.split(","))]))
    sensors = list(dict.fromkeys(name.strip() for name in sensor.split(",")))
    trees = [tree.rglob("*") for tree in (images, labels) if tree is not None and tree.is_dir()]
    named = [Path(name) for name in (*sensors, *names, reference) if name]
    read = (images, labels, detector, *chain.from_iterable(trees), *named)
    require_writable(out / REPORT, json, inputs=read, folders=(out,))
    known = {} if classes is None else parse_classes(classes)
    request = DetectionRequest(
        images, labels, split, detector, sensors, reference, names, size, known, drawn, retrain, seed
    )
    found = run_detection(request, Cache(out / "cache"), say)
    show(found)
    say(f"wrote {found.write(out)}")
    arguments: dict[str, object] = {"images": images, "labels": labels, "split": split, "detector": detector}
    arguments |= {"sensor": sensor, "reference": reference, "methods": methods, "size": size, "classes": classes}
    arguments |= {"drawn": drawn, "retrain": retrain, "out": out, "seed": seed}
    Document("detect", arguments, (request.detector_file, *found.pictures), found.rows).write(json)


def _refuse_unused(context: typer.Context) -> None:
    """Refuse what only pictures have, or only drawn scenes; only of these are some left to train on."""
    remedy = "leave it out"
    if context.params["images"] is None:
        refuse(context, ["labels", "split"], expected="--images beside it", got="none", remedy=remedy)
    else:
        refuse(context, ["drawn", "retrain"], expected="drawn scenes", got="--images beside it", remedy=remedy)
    if context.params["detector"] is not None:
        refuse(context, ["retrain"], expected="the embedded detector", got="--detector beside it", remedy=remedy)


def show(found: "DetectionRun") -> None:
    """The tables that answer the question, the paper's, and what a reader must know."""
    from deploy.results import print_rows
    from profiles.figures import by_table

    for table, rows in by_table(found.shown).items():
        print_rows(table, rows)
    for sentence in (*found.notes, found.headline):
        say(sentence)
