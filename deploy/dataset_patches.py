"""Patches of simulated pairs. Their pixels depend on the recipe and their number alone: not on who makes them."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from deploy.restore import write_tiff
from model.files import sha256
from model.simulator.acquire import MARGIN_PX, prepare_scene, simulate_planned
from model.simulator.digitise import to_uint16
from model.simulator.draws import Draw
from model.simulator.plan import TOLERANCE_DN, make_plan
from model.simulator.procedural import procedural_scene
from model.simulator.sampling import resample
from model.simulator.scene import Scene, read_scene
from profiles.errors import ImageError
from profiles.sensor import SensorProfile, require_same_units

DRAWN_SIDE_PX = 3000
Line = dict[str, object]
"""Of the manifest: one patch."""


@dataclass(frozen=True)
class DatasetRecipe:
    """All that decides a dataset's pixels."""

    scenes: tuple[Path | None, ...]  # None: a drawn scene
    degraded: SensorProfile
    reference: SensorProfile
    oversampling: int
    patch_px: int | None  # None: each scene whole
    radiance_scale: float = 1.0
    seed: int = 0
    tolerance_dn: float = TOLERANCE_DN
    scene_scale: float = 1.0  # scenes are resampled by it first, where the wanted ratio is no whole number

    def __post_init__(self) -> None:
        require_same_units(self.degraded, self.reference)

    def to_json(self) -> dict[str, object]:
        """The recipe as a file keeps it; scenes by name and digest."""
        scenes = [{"name": p.name, "sha256": sha256(p)} if p else {"name": "drawn"} for p in self.scenes]
        profiles = {role: asdict(p) for role, p in (("degraded", self.degraded), ("reference", self.reference))}
        keys = ("oversampling", "scene_scale", "patch_px", "radiance_scale", "seed", "tolerance_dn")
        rest = {key: getattr(self, key) for key in keys}
        return {"scenes": scenes, **profiles, **rest}


@dataclass(frozen=True)
class Window:
    """One patch: its number in the dataset, its scene, and the top left of its margin in scene pixels."""

    number: int
    scene: int
    name: str
    top: int
    left: int
    height: int
    width: int


def plan_windows(recipe: DatasetRecipe) -> list[Window]:
    """Every patch of a dataset, in order.

    Raises:
        ImageError: a scene that holds none.
    """
    windows: list[Window] = []
    for index, path in enumerate(recipe.scenes):
        found = list(_scene_windows(recipe, index, len(windows)))
        if not found:
            side = ((recipe.patch_px or 1) + 2 * MARGIN_PX) * recipe.oversampling
            raise ImageError(
                str(path), expected=f"at least {side} scene pixels a side", got="less", remedy="leave it out"
            )
        windows += found
    return windows


def _scene_windows(recipe: DatasetRecipe, index: int, first: int) -> Iterator[Window]:
    path, ratio = recipe.scenes[index], recipe.oversampling
    height, width = load(recipe, index).radiance.shape
    stem = f"{index:04d}-{path.stem if path else 'drawn'}"
    if recipe.patch_px is None:
        if min(height, width) // ratio > 2 * MARGIN_PX:
            yield Window(first, index, stem, 0, 0, height, width)
        return
    side, step = (recipe.patch_px + 2 * MARGIN_PX) * ratio, recipe.patch_px * ratio
    corners = [(y, x) for y in range(0, height - side + 1, step) for x in range(0, width - side + 1, step)]
    for k, (top, left) in enumerate(corners):
        yield Window(first + k, index, f"{stem}-{k:05d}", top, left, side, side)


def load(recipe: DatasetRecipe, index: int) -> Scene:
    """A scene of the recipe, its radiance scaled."""
    path = recipe.scenes[index]
    if path is None:
        generator = Draw(recipe.seed, index).generator("drawn scene")
        scene = procedural_scene(DRAWN_SIDE_PX, DRAWN_SIDE_PX, generator)
    else:
        scene = read_scene(path, recipe.reference.nominal())
    radiance = scene.radiance * recipe.radiance_scale
    if recipe.scene_scale != 1:
        height, width = (round(side * recipe.scene_scale) for side in radiance.shape)
        radiance = resample(radiance, height, width)
    return Scene(scene.name, radiance)


def make_patches(recipe: DatasetRecipe, windows: list[Window], out: Path) -> list[Line]:
    """Simulate and write some patches of one scene; returns their lines of the manifest."""
    torch.set_num_threads(1)
    radiance = load(recipe, windows[0].scene).radiance
    return [_make_patch(recipe, window, radiance, out) for window in windows]


def _make_patch(recipe: DatasetRecipe, window: Window, radiance: torch.Tensor, out: Path) -> Line:
    bottom, right = window.top + window.height, window.left + window.width
    part = prepare_scene(radiance[window.top : bottom, window.left : right], recipe.oversampling)
    draw = Draw(recipe.seed, window.number)
    line: Line = {"number": window.number, "name": window.name, "seed": recipe.seed}
    line |= {"source": window.name.split("-", 1)[1], "top_px": window.top, "left_px": window.left}
    for role, profile in (("degraded", recipe.degraded), ("reference", recipe.reference)):
        sensor, rejected = profile.draw_counted(draw.generator(f"sensor-{role}"))
        plan = make_plan(sensor, part.stats, recipe.tolerance_dn)
        dn = simulate_planned(part, sensor, draw, plan, role)
        write_tiff(out / role / f"{window.name}.tif", to_uint16(dn))
        line[role] = {"sensor": asdict(sensor), "rejected_snr_pairs": rejected, "plan": plan.to_json()}
    return line
