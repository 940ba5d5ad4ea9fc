"""`beers-deploy simulate`: what two sensors would see of a scene, as 12-bit TIFF pairs; or why,
with --explain.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import Reference, Seed, refuse, say
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.scene_call import calling_for, load_scene_call, origins
from beers_deploy.profiles.sensor_file import reference_beside

if TYPE_CHECKING:
    from beers_deploy.model.dataset import DatasetRecipe


MIN_RATIO = 2
"""Below it the blur's kernel has negative lobes of its own (0.7 % of its peak at 7 %)."""

PRESETS = {
    "paper-variable": ("pleiades-variable", 128),
    "paper-fixed": (SENSOR, 128),
    "paper-test": (SENSOR, 1500),
    "dior-medium": ("dior-medium", 256),
    "dior-high": ("dior-high", 256),
}
"""The paper's datasets (table 1, and the table of DIOR parameters): sensor, and patch side in
pixels.
"""


def simulate(
    context: typer.Context,
    scenes: Annotated[
        list[Path] | None, typer.Argument(help="Images: 8-bit, 16-bit DN, float; drawn if none.")
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder of the dataset.")] = None,
    sensor: Annotated[
        str | None, typer.Option(help=f"Profile of the degraded images; {SENSOR} if none.")
    ] = None,
    reference: Reference = None,
    preset: Annotated[
        str | None, typer.Option(help=f"A dataset of the paper: {', '.join(PRESETS)}.")
    ] = None,
    patch: Annotated[
        int | None,
        typer.Option(min=8, max=8192, help="Patch side in pixels; whole scenes if none."),
    ] = None,
    oversampling: Annotated[
        float | None,
        typer.Option(
            min=1, max=64, help="Scene pixels per pixel, whole or not; the profile's if none."
        ),
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(help="What the scene calls for: night-port, snow, ..., or a .toml."),
    ] = None,
    add: Annotated[
        list[str] | None, typer.Option("--with", help="Effect to add, at typical values.")
    ] = None,
    forbid: Annotated[
        list[str] | None, typer.Option("--without", help="Effect to leave out.")
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Show for each effect what is decided, and why.")
    ] = False,
    tolerance: Annotated[
        float, typer.Option(min=0, help="DN by which skipping may change a pixel.")
    ] = 0.25,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0 takes every core.")] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler whose workers simulate, such as tcp://host:8786."),
    ] = None,
    seed: Seed = 0,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on with an unfinished dataset; pairs that do not match the manifest are "
            "made again.",
        ),
    ] = False,
) -> None:
    """Write pairs of images, degraded/NAME.tif and reference/NAME.tif, of scenes or patches.

    The workers of a scheduler must find the same scenes under the same paths; only this process
    writes.
    """
    import math
    import os

    from beers_deploy.cluster import open_cluster
    from beers_deploy.model.dataset import DatasetRecipe, plan_windows, write_dataset
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.processor import require_cores
    from beers_deploy.model.progress import steps

    if out is None:
        expected = "--out beside it"
        remedy = "leave it out, or give a folder"
        refuse(context, ["workers", "scheduler", "resume"], expected=expected, remedy=remedy)
    if scheduler is not None:
        refuse(
            context,
            ["workers"],
            expected="none beside --scheduler",
            got="some",
            remedy="leave one of them out",
        )
    require_cores("--workers", workers)
    if out is not None:
        inputs = (*(scenes or ()), *(Path(name) for name in (sensor, reference, scene) if name))
        folders = [out / name for name in ("degraded", "reference", "parts")]
        require_writable(
            out / "manifest.jsonl", out / "recipe.json", inputs=inputs, folders=folders
        )
    usual, patch_px = _preset(preset)
    call = load_scene_call(scene) if scene else None
    own = load_sensor(sensor or usual)
    degraded = calling_for(own, call, add or (), forbid or ())
    scene_ratio = oversampling or degraded.oversampling.low
    # The scene is resampled first where its ratio is no whole number.
    ratio = math.ceil(scene_ratio)
    recipe = DatasetRecipe(
        tuple(scenes) if scenes else (None,),
        degraded,
        reference_beside(degraded, reference, say),
        ratio,
        patch or patch_px,
        call.radiance_scale.low if call else 1.0,
        seed,
        tolerance,
        ratio / scene_ratio,
    )
    if ratio < MIN_RATIO:
        say(
            f"note: at {ratio} scene pixel a pixel the blur itself rings near sharp edges", err=True
        )
    if out is None and not explain:
        raise OptionError(
            "--out", expected="a folder", got="none", remedy="give one, or ask for --explain alone"
        )
    if explain:
        _explain(recipe, origins(own, call, add or (), forbid or ()))
    if out is None:
        return
    with open_cluster(scheduler) as cluster, steps("simulating", len(plan_windows(recipe))) as bar:
        # Without a scheduler, the data set starts processes of its own.
        count = cluster.slots if cluster else workers or os.cpu_count() or 1
        pool = cluster.pool if cluster else None
        summary = write_dataset(recipe, out, count, resume, bar.advance, pool, say)
    rejected = (
        f"; {summary['rejected_share']:.1%} of the drawn SNR pairs were impossible and drawn again"
    )
    pairs = f"{summary['patches']:.0f} pair{'' if summary['patches'] == 1 else 's'}"
    say(f"wrote {pairs} to {out}" + (rejected if summary["rejected_share"] else ""))


def _preset(name: str | None) -> tuple[str, int | None]:
    """The sensor and the patch side of a dataset of the paper; of none the sensor of all commands,
    and no side.
    """
    if name is None:
        return SENSOR, None
    if name not in PRESETS:
        raise OptionError(
            "--preset", expected=f"one of {', '.join(PRESETS)}", got=repr(name), remedy="choose one"
        )
    return PRESETS[name]


def _explain(recipe: "DatasetRecipe", origins: Mapping[str, str]) -> None:
    """The plan of the first draw of the degraded sensor, for every scene."""
    from rich.table import Table

    from beers_deploy.model.dataset import load
    from beers_deploy.model.simulator.acquire import prepare_scene
    from beers_deploy.model.simulator.detector import Draw
    from beers_deploy.model.simulator.plan import make_plan
    from beers_deploy.results import default_console, plain

    for index in range(len(recipe.scenes)):
        scene = load(recipe, index)
        stats = prepare_scene(scene.radiance, recipe.oversampling).stats
        sensor = recipe.degraded.draw(Draw(recipe.seed, index).generator("sensor-degraded"))
        title = plain(
            f"{scene.name}: {stats.low:.1f} to {stats.high:.1f} W/m2/sr/um, {recipe.degraded.name}"
        )
        table = Table(
            "effect",
            "from",
            "decision",
            "why",
            "bound DN",
            "cost",
            title=title,
            title_justify="left",
        )
        for d in make_plan(sensor, stats, recipe.tolerance_dn).decisions:
            bound = "" if d.bound_dn is None else f"{d.bound_dn:.3g}"
            table.add_row(
                *map(plain, (d.effect, origins.get(d.effect, ""), d.choice, d.why, bound, d.cost))
            )
        default_console().print(table)
