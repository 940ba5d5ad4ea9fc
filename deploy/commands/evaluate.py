"""`beers-deploy evaluate`: several restorations on the same pairs, judged by
the same instruments.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from beers_deploy.commands.shared import Json, Lpips, Reference, Seed, save, say
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError


def evaluate(
    images: Annotated[
        Path | None, typer.Option(help="Folder of scenes to simulate from; drawn ones if none.")
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(help="Folder with degraded/ and reference/, as 'simulate' writes."),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help=f"Profile of the degraded images; of pairs the recipe's, else {SENSOR} if none."
        ),
    ] = None,
    reference: Reference = None,
    methods: Annotated[
        str, typer.Option(help="Names, separated by commas.")
    ] = "degraded,traditional,deconvolve-first,convbeers-s,convbeers-s-int8",
    lpips: Lpips = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for report.html and pictures.")
    ] = None,
    sweep: Annotated[
        bool,
        typer.Option(
            "--sweep", help="Also under 16 sensors known as they are, and 7 known wrongly."
        ),
    ] = False,
    brightness: Annotated[
        str | None,
        typer.Option(help="Also with the scenes' radiance times these factors: 0.25,0.05."),
    ] = None,
    consistency: Annotated[
        bool,
        typer.Option(
            "--consistency/--no-consistency", help="Networks that know the sensor take the step."
        ),
    ] = True,
    exposure: Annotated[
        bool,
        typer.Option(
            "--exposure/--no-exposure",
            help="Shipped networks restore dark parts at a higher exposure.",
        ),
    ] = True,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Refuse pairs whose pixels contradict the sensor, instead of saying so.",
        ),
    ] = False,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Compare restorations with the reference, on average and by site, beside the degraded input.

    PSNR leaves out clipped pixels; of simulated pairs it is also taken against the reference
    without its noise. Inner PSNR leaves out a border of 57 pixels. MTF and SNR are measured on
    restored slanted edges and flat fields; the table of targets has the flux of points and the
    contrast of faint bars and zone plates. Traditional methods and shipped networks know the
    sensors' nominal figures; NAME@blind is told no sensor, NAME@SENSOR another one.
    """
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.raster.images import list_images
    from beers_deploy.results import print_rows

    if pairs is not None and (images is not None or sweep or brightness):
        expected = "no --images, --sweep or --brightness with it: pairs are as they are"
        raise OptionError("pairs", expected=expected, got="both", remedy="leave one out")
    factors = parse_brightness(brightness)
    # A method that is named twice is measured once, in the order of the command line.
    names = list(dict.fromkeys(name.strip() for name in methods.split(",")))
    folders = [pairs, *(pairs / role for role in ("degraded", "reference"))] if pairs else [images]
    inputs = (*folders, lpips, *(Path(name) for name in (sensor, reference, *names) if name))
    require_writable(out / "report.html" if out else None, json, inputs=inputs, folders=(out,))
    if images is not None:
        # An empty folder is refused before torch is loaded.
        list_images(images)
    from beers_deploy.studies.evaluation.run import evaluate as compared

    about: dict[str, Any] = {
        "sensor": sensor,
        "reference": reference,
        "lpips": lpips,
        "brightness": factors,
    }
    about |= {"consistency": consistency, "exposure": exposure}
    table = compared(
        names, pairs, images=images, sweep=sweep, strict=strict, seed=seed, log=say, **about
    )
    for title, rows in {table.title: table.mean, **table.more}.items():
        print_rows(title, rows)
    for note in table.notes:
        say(note)
    if out is not None:
        say(f"wrote {table.report(out)}")
    save(table, json)


def parse_brightness(text: str | None) -> tuple[float, ...]:
    """Return the factors of radiance that a user wrote, separated by commas; 1 alone if none."""
    try:
        return tuple(float(factor) for factor in (text or "1").split(","))
    except ValueError as error:
        expected = "numbers separated by commas"
        remedy = "give factors such as 0.25,0.05"
        raise OptionError("brightness", expected=expected, got=repr(text), remedy=remedy) from error
