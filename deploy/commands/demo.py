"""`beers-deploy demo`: the whole chain on one image, with a report at the end."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import Json, Seed, arguments, save, say
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError


def demo(
    image: Annotated[
        Path | None, typer.Option(help="Raw 12-bit image, or an 8-bit photograph as scene.")
    ] = None,
    full_scale: Annotated[
        float | None,
        typer.Option(
            help="Pixel value of a raw image that is full scale; 4095 if none, needed for 0..1."
        ),
    ] = None,
    sensor: Annotated[
        str,
        typer.Option(
            help="Of the raw image, or to simulate: a profile's name or your .toml file, 12 bits."
        ),
    ] = SENSOR,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for report and files.")] = Path(
        "demo"
    ),
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Simulate, quantise, gate, check, restore and predict one scene; ends with report.html."""
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.report.page import write_report
    from beers_deploy.results import Table, print_rows
    from beers_deploy.studies.demo import FILES, run_demo

    if full_scale is not None and image is None:
        raise OptionError(
            "--full-scale", expected="--image beside it", got="none", remedy="leave it out"
        )
    require_writable(*(out / name for name in FILES), json, inputs=(image, Path(sensor)))
    report = run_demo(image, out, seed, lambda step: say(step, err=True), full_scale, sensor)
    write_report(report, out / "report.html")
    for table in report.tables:
        print_rows(table.title, table.rows)
    say(report.headline)
    say(f"report: {out / 'report.html'}")
    rows = tuple(chain.from_iterable(table.rows for table in report.tables))
    save(Table("demo", arguments(), tuple([image] if image else []), rows), json)
