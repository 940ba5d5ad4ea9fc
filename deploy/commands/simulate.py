"""`beers-deploy simulate`: what two sensors would see of a scene, as 12-bit TIFF pairs."""

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "simulate aerial.png --sensor pleiades-degraded --out pairs"


def simulate(
    scenes: Annotated[list[Path], typer.Argument(help="Images: 8-bit RGB or mono, 16-bit DN, float radiance.")],
    out: Annotated[Path, typer.Option(help="Folder of the pairs.")],
    sensor: Annotated[str, typer.Option(help="Profile of the degraded image.")] = "pleiades-degraded",
    reference: Annotated[str, typer.Option(help="Profile of the reference image.")] = "pleiades-reference",
    oversampling: Annotated[
        int | None, typer.Option(min=1, help="Scene pixels per pixel; the profile's if none.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of every random draw.")] = 0,
) -> None:
    """Write NAME-degraded.tif and NAME-reference.tif for each scene; the same bytes for the same seed."""
    from deploy.progress import steps
    from deploy.restore import write_tiff
    from model.simulator.acquire import simulate_pair
    from model.simulator.digitise import to_uint16
    from model.simulator.draws import Draw
    from model.simulator.scene import read_scene
    from profiles import load_sensor

    degraded_profile, reference_profile = load_sensor(sensor), load_sensor(reference)
    ratio = oversampling or int(degraded_profile.oversampling.low)
    with steps("simulating", len(scenes)) as bar:
        for number, path in enumerate(scenes):
            draw = Draw(seed, number)
            eyes = [p.draw(draw.generator("sensor")) for p in (degraded_profile, reference_profile)]
            pair = simulate_pair(read_scene(path, eyes[1]).radiance, eyes[0], eyes[1], ratio, draw)
            write_tiff(out / f"{path.stem}-degraded.tif", to_uint16(pair.degraded))
            write_tiff(out / f"{path.stem}-reference.tif", to_uint16(pair.reference))
            bar.advance(note=path.name)
    typer.echo(f"wrote {2 * len(scenes)} images to {out}")
