"""`beers-deploy evaluate`: PSNR and SSIM of several methods on the same simulated pairs."""

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "evaluate --images aerial/ --methods degraded,traditional,convbeers-s,convbeers-s-int8"


def evaluate(
    images: Annotated[Path | None, typer.Option(help="Folder of scenes; drawn ones if none.")] = None,
    sensor: Annotated[str, typer.Option(help="Profile of the degraded images.")] = "pleiades-degraded",
    reference: Annotated[str, typer.Option(help="Profile of the reference images.")] = "pleiades-reference",
    methods: Annotated[
        str, typer.Option(help="Names, separated by commas.")
    ] = "degraded,convbeers-s,convbeers-s-int8",
    seed: Annotated[int, typer.Option(min=0, help="Seed of every random draw.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Compare restorations with the reference image, per image and on average; the degraded input is a row."""
    from deploy.defaults import load_scenes
    from deploy.evaluate import method_named, score, simulate_pairs
    from deploy.progress import steps
    from deploy.results import Document
    from deploy.tables import print_rows
    from model.files import require_writable
    from profiles import load_sensor
    from profiles.errors import ImageError

    require_writable(json)
    eyes = load_sensor(sensor), load_sensor(reference)
    names = list(dict.fromkeys(["degraded", *(name.strip() for name in methods.split(","))]))
    chosen = [(name, method_named(name, *eyes)) for name in names]
    pairs, small = simulate_pairs(load_scenes(images, eyes[1].nominal(), seed), *eyes, seed)
    if not pairs:
        raise ImageError(
            str(images), expected="scenes of 224 pixels a side or more", got="none", remedy="give larger"
        )
    rows = []
    for name, method in chosen:
        with steps(name, len(pairs)) as bar:
            rows += score(name, method, pairs, bar.advance)
    print_rows(f"{sensor} -> {reference}, {len(pairs)} images", [row for row in rows if row.table == "mean"])
    if small:
        typer.echo(f"left out, too small: {', '.join(small)}")
    arguments = {"images": images, "sensor": sensor, "reference": reference, "methods": methods, "seed": seed}
    Document("evaluate", arguments, (), tuple(rows)).write(json)
