"""`simulate`: what two sensors see of a scene: a pair of images, or a data set of pairs."""

import logging
import math
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError
from beers_deploy.verbs.parameters import (
    Effects,
    Holds,
    Images,
    InputPath,
    Interval,
    OutputFolder,
    Progress,
    PythonOnly,
    RequiredUnless,
    Seed,
    SensorLike,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.model.dataset import DatasetRecipe
    from beers_deploy.pairs import Pair
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.results import Table

logger = logging.getLogger(__name__)

PRESETS = {
    "paper-variable": ("pleiades-variable", 128),
    "paper-fixed": (SENSOR, 128),
    "paper-test": (SENSOR, 1500),
    "dior-medium": ("dior-medium", 256),
    "dior-high": ("dior-high", 256),
}
"""The paper's data sets (table 1, and the table of DIOR parameters): sensor, and patch side in
pixels.
"""
MIN_RATIO = 2
"""Below it the blur's kernel has negative lobes of its own (0.7 % of its peak at 7 %)."""

DATA_SET = Holds("manifest.jsonl", "recipe.json", folders=("degraded", "reference", "parts"))


@verb
def simulate(
    *,
    images: Images | None = None,
    out: Annotated[OutputFolder, DATA_SET, RequiredUnless("explain")] | None = None,
    sensor: SensorLike | None = None,
    reference: SensorLike | None = None,
    preset: Literal["paper-variable", "paper-fixed", "paper-test", "dior-medium", "dior-high"]
    | None = None,
    size: Annotated[int, Interval(ge=1, le=4096), PythonOnly()] = 512,
    patch: Annotated[int, Interval(ge=8, le=8192)] | None = None,
    oversampling: Annotated[float, Interval(ge=1, le=64)] | None = None,
    scene: InputPath | None = None,
    with_: Effects = (),
    without: Effects = (),
    explain: bool = False,
    tolerance: Annotated[float, Interval(ge=0)] = 0.25,
    workers: Annotated[int, Interval(ge=0)] = 0,
    scheduler: str | None = None,
    seed: Seed = 0,
    resume: bool = False,
    progress: Progress = None,
) -> "Pair | Table":
    """Simulate what a sensor sees of a scene, and what a better one sees.

    Pairs, of whole scenes or of patches, are written as TIFFs degraded/NAME.tif and
    reference/NAME.tif.

    Args:
        images: scenes: image files, or folders of them, of 8 bits, 16-bit DN or float radiance;
            repeat it for several. In Python also the pixels of one. A drawn scene by default.
        out: folder of the data set; in Python one pair is returned by default.
        sensor: sensor of the degraded images, whose ranges are drawn from: name or .toml file;
            pleiades-degraded by default.
        reference: sensor of the reference images; pleiades-reference by default.
        preset: data set of the paper: its sensor and its patch size.
        size: side in pixels of the pair of a drawn scene, in Python.
        patch: side of a patch in pixels; whole scenes by default.
        oversampling: number of scene pixels for each pixel; the sensor's by default.
        scene: scene whose light and effects are applied, such as night-port, or a .toml file.
        with_: effect to add, at typical values; repeat it for several.
        without: effect to leave out; repeat it for several.
        explain: print for each effect what is decided and why, and write nothing.
        tolerance: largest change of a pixel in DN for which an effect is skipped.
        workers: number of processes; 0 uses all cores.
        scheduler: address of a Dask scheduler whose workers simulate, such as tcp://host:8786; they
            must find the scenes under the same paths.
        seed: seed of every random draw.
        resume: continue an unfinished data set; pairs that do not match the manifest are simulated
            again.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of the data set or of the decisions; without `out` a pair, which unpacks into the
        degraded and the reference image.

    Raises:
        ImageError: a scene that cannot be read, or that is too small for the blur.
        ProfileError: no such sensor or scene.
        OptionError: no such effect, or options that do not go together.

    Examples:
        >>> degraded, reference = bd.simulate(sensor="pleiades-degraded", size=96, seed=1)
        >>> degraded.shape, degraded.dtype
        ((96, 96), dtype('uint16'))
    """
    options = partial(changed, simulate, locals())

    from beers_deploy.profiles.scene_call import SceneCall, calling_for, origins
    from beers_deploy.profiles.sensor import Sensor

    if out is None:
        refuse_without("`out`", **options("resume", "workers", "scheduler"))
    else:
        refuse_with("`out`", **options("explain", "size"))
    if scheduler is not None:
        refuse_with("`scheduler`", **options("workers"))
    usual, patch_px = (SENSOR, None) if preset is None else PRESETS[preset]
    call = None if scene is None else SceneCall.load(os.fspath(scene))
    own = Sensor.load(sensor or usual)
    added, removed = ([n] if isinstance(n, str) else n for n in (with_, without))
    degraded = calling_for(own, call, added, removed)
    scale = call.radiance_scale.low if call else 1.0
    if out is None and not explain:
        refuse_without("`out`", **options("preset", "patch", "tolerance"))
        from beers_deploy.pairs import simulated_pair

        aim = degraded.reference if reference is None else Sensor.load(reference)
        ratio = _whole(oversampling or int(degraded.oversampling.low))
        several = images if isinstance(images, list | tuple) else [images]
        if len(several) > 1:
            raise OptionError(
                f"`images` must be one scene without `out`, got {len(several)}. Add `out` to write "
                "a data set."
            )
        one = several[0] if several else None
        return simulated_pair(one, degraded, aim, size, scale, ratio, seed)
    recipe = _recipe(
        _files(images), degraded, reference, oversampling, patch or patch_px, scale, seed, tolerance
    )
    if out is None:
        return _decisions(recipe, origins(own, call, added, removed))
    return _write(recipe, Path(out), workers, scheduler, resume)


def _whole(oversampling: float) -> int:
    """Return a ratio that is an integer: only a data set resamples its scenes."""
    if oversampling != int(oversampling):
        raise OptionError(
            f"`oversampling` must be an integer without `out`, got {oversampling:g}. Round it, or "
            "add `out` to write a data set."
        )
    return int(oversampling)


def _files(images: Images | None) -> list[Path | None]:
    """Return the image files of scenes and folders; [None] for a drawn scene."""
    from beers_deploy.model.raster.images import list_images

    files: list[Path | None] = []
    several = images if isinstance(images, list | tuple) else [images]
    for image in several:
        if image is not None and not isinstance(image, str | os.PathLike):
            raise OptionError("`images` must be paths for a data set. Save the pixels first.")
        path = path_or_none(image)
        files += list_images(path) if path and path.is_dir() else [path]
    return files or [None]


def _recipe(
    scenes: list[Path | None],
    degraded: "Sensor",
    reference: SensorLike | None,
    oversampling: float | None,
    patch_px: int | None,
    radiance_scale: float,
    seed: int,
    tolerance_dn: float,
) -> "DatasetRecipe":
    """Return the recipe of a data set, which determines its pixels."""
    from beers_deploy.model.dataset import DatasetRecipe
    from beers_deploy.profiles.reference import reference_for

    scene_ratio = oversampling or degraded.oversampling.low
    # The scene is resampled first where its ratio is no integer.
    ratio = math.ceil(scene_ratio)
    if ratio < MIN_RATIO:
        logger.warning(
            "at %d scene pixel for each pixel, the simulated blur itself rings near sharp edges: "
            "give scenes of a higher resolution",
            ratio,
        )
    return DatasetRecipe(
        tuple(scenes),
        degraded,
        reference_for(degraded, reference),
        ratio,
        patch_px,
        radiance_scale,
        seed,
        tolerance_dn,
        ratio / scene_ratio,
    )


def _write(
    recipe: "DatasetRecipe",
    out: Path,
    workers: int,
    scheduler: str | None,
    resume: bool,
) -> "Table":
    """Write a data set, and return a table of it."""
    from beers_deploy.model.dataset import write_dataset
    from beers_deploy.model.processor import require_cores
    from beers_deploy.profiles.figures import Row, measured
    from beers_deploy.restoration.cluster import open_cluster
    from beers_deploy.results import Table

    require_cores("workers", workers)
    scenes = [path for path in recipe.scenes if path is not None]
    with open_cluster(scheduler) as cluster:
        # Without a scheduler, the data set starts processes of its own.
        count = cluster.slots if cluster else workers or os.cpu_count() or 1
        pool = cluster.pool if cluster else None
        summary = write_dataset(recipe, out, count, resume, pool)
    rejected = "SNR pairs drawn again because they were physically impossible"
    figures = {
        "pairs": measured(summary["patches"], "pair", "the manifest"),
        "rejected draws": measured(100 * summary["rejected_share"], "%", rejected),
    }
    return Table(
        title=f"wrote {out}",
        inputs=tuple(scenes),
        rows=(Row("pairs", f"{recipe.degraded.name} -> {recipe.reference.name}", figures),),
        headings={"pairs": ""},
    )


def _decisions(recipe: "DatasetRecipe", origins: Mapping[str, str]) -> "Table":
    """Return the decision on each effect, for the first draw of the sensor and every scene."""
    from beers_deploy.model.dataset import load
    from beers_deploy.model.simulator.acquire import prepare_scene
    from beers_deploy.model.simulator.detector import Draw
    from beers_deploy.model.simulator.plan import make_plan
    from beers_deploy.profiles.figures import Row, predicted
    from beers_deploy.results import Table

    rows = []
    for index in range(len(recipe.scenes)):
        scene = load(recipe, index)
        stats = prepare_scene(scene.radiance, recipe.oversampling).stats
        sensor = recipe.degraded.draw(Draw(recipe.seed, index).generator("sensor-degraded"))
        radiances = f"{stats.low:.1f} to {stats.high:.1f} W/m2/sr/um"
        name = f"{scene.name}: {radiances}, {recipe.degraded.name}"
        for each in make_plan(sensor, stats, recipe.tolerance_dn).decisions:
            figures = {}
            if each.bound_dn is not None:
                source = "largest change of a pixel, by the effect's own formula"
                figures["bound"] = predicted(each.bound_dn, "DN", (0.0, each.bound_dn), source)
            words = {"from": origins.get(each.effect, ""), "decision": each.choice}
            words |= {"why": each.why, "cost": each.cost}
            rows.append(Row(name, each.effect, figures, words))
    scenes = tuple(path for path in recipe.scenes if path is not None)
    return Table(title="effects and decisions", inputs=scenes, rows=tuple(rows))
