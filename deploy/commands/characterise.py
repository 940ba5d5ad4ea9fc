"""`beers-deploy characterise`: a sensor profile from the user's own raw images, with intervals."""

from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import arguments, save, say

EXAMPLE = "characterise raw1.tif raw2.tif --bits 12 --out my-sensor.toml"


def characterise(
    images: Annotated[list[Path], typer.Argument(help="Raw images of one sensor: whole digital numbers, one band.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The sensor profile, a TOML file.")],
    edge: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE:X,Y,WIDTH,HEIGHT", help="A box with one straight edge; searched for if none."),
    ] = None,
    bits: Annotated[
        int | None, typer.Option(min=1, max=16, help="Of a digital number; told by clipped pixels if none.")
    ] = None,
    gain: Annotated[
        float | None, typer.Option(help="DN per W/m2/sr/um; full scale is taken for 400 W/m2/sr/um if none.")
    ] = None,
    gsd: Annotated[float | None, typer.Option(help="Ground sampling distance in m; no pixel depends on it.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures with their intervals here.")] = None,
) -> None:
    """Measure MTF and noise on raw images and write them as a sensor profile, for every --sensor.

    The MTF needs straight edges between even areas: a target, a large roof, an apron. The noise needs raw pixels:
    what was denoised, sharpened or resampled is refused.
    """
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.results import Table, print_rows
    from beers_deploy.studies.characterise import characterise as measure
    from beers_deploy.studies.characterise import profile_toml

    require_writable(out, json, inputs=images)
    found = measure(images, edge or (), bits=bits, gain=gain, gsd_m=gsd)
    rows = found.rows()
    print_rows(f"sensor of {len(images)} image{'' if len(images) == 1 else 's'}", rows)
    write_text(out, profile_toml(found))
    save(Table("characterise", arguments(), tuple(images), tuple(rows)), json)
    say(f"wrote {out}: beers-deploy profiles {out}")
