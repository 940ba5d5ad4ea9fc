"""Datasets of simulated pairs: 12-bit TIFF patches and a manifest, in parallel, resumable, the same bytes always.

A patch's pixels depend on the recipe and its number alone, not on who makes it. The workers of a cluster need to
read the scenes; only this process writes.
"""

import json
import multiprocessing
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from deploy.cluster import open_cluster, unreachable
from deploy.restoration.arrays import write_tiff
from model.io.files import sha256, whole_file, write_text
from model.simulator.acquire import MARGIN_PX, prepare_scene, simulate_planned
from model.simulator.detector import Draw, to_uint16
from model.simulator.plan import TOLERANCE_DN, make_plan
from model.simulator.procedural import procedural_scene
from model.simulator.sampling import Scene, read_scene, resample
from profiles.errors import ImageError, OptionError
from profiles.sensor import SensorProfile, require_same_units
from profiles.toml import parse_json

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


@dataclass(frozen=True)
class Order:
    """What is to be made, and the digests of its scenes; None for a drawn one."""

    recipe: DatasetRecipe
    digests: tuple[str | None, ...]


@dataclass(frozen=True)
class Made:
    """Patches as files, by their path in the dataset, and their lines of the manifest."""

    files: dict[str, bytes]
    lines: list[Line]


def spread_patches(
    recipe: DatasetRecipe, waiting: dict[Path, list[Window]], out: Path, scheduler: str
) -> Iterator[tuple[Path, list[Line]]]:
    """Make and write the patches of each part; yields its path and its lines.

    Raises:
        ImageError: a scene that a worker cannot read.
        MachineError: Dask, its workers, or a disk.
    """
    scenes = tuple(path.absolute() if path else None for path in recipe.scenes)
    order = Order(replace(recipe, scenes=scenes), tuple(sha256(path) if path else None for path in scenes))
    with (
        open_cluster(0, scheduler) as workers,
        closing(workers.in_order(make_files, workers.share(order), waiting.values(), lambda: None)) as pieces,
    ):
        for path, made in zip(waiting, pieces, strict=True):
            for name, content in made.files.items():
                with whole_file(out / name) as temporary:
                    temporary.write_bytes(content)
            yield path, made.lines


def make_files(order: Order, windows: list[Window]) -> Made:
    """In a worker: some patches of one scene.

    Raises:
        ImageError: no such scene here, or another file of that name.
    """
    scene = windows[0].scene
    _check_scene(order.recipe.scenes[scene], order.digests[scene])
    with TemporaryDirectory() as name:
        folder = Path(name)
        lines = make_patches(order.recipe, windows, folder)
        files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.tif"))}
    return Made(files, lines)


@lru_cache(maxsize=64)
def _check_scene(path: Path | None, digest: str | None) -> None:
    """Once for each scene and process."""
    if path is None:
        return
    try:
        found = sha256(path)
    except OSError as error:
        raise unreachable(path, error.strerror or str(error)) from error
    if found != digest:
        raise unreachable(path, "another file of that name")


CHUNK = 32
"""Patches a worker makes before it reports: short enough to lose little to a kill."""
MOST_PROCESSES = 61 if sys.platform == "win32" else 1 << 16
"""Windows waits for no more at once, and Python refuses a larger pool."""


def write_dataset(
    recipe: DatasetRecipe,
    out: Path,
    workers: int,
    resume: bool,
    tick: Callable[[int], None],
    scheduler: str | None = None,
) -> dict[str, float]:
    """Write a dataset by processes here, or by the workers of a Dask scheduler.

    `tick` is told how many further patches are done.

    Returns:
        patches, and the share of drawn SNR pairs that were impossible and drawn again.

    Raises:
        OptionError: the folder holds another dataset, or this one without `resume`.
        MachineError: the cluster fails.
    """
    _check_folder(recipe, out, resume)
    if (out / "manifest.jsonl").exists():  # nothing was left to do
        return _read_summary(out / "manifest.jsonl")
    for left_over in out.rglob(".*.part"):  # of a run that was killed
        if not left_over.is_dir():
            left_over.unlink()
    windows = plan_windows(recipe)
    chunks = [c for _, group in groupby(windows, key=lambda w: w.scene) for c in _chunks(list(group))]
    parts = {out / "parts" / f"{chunk[0].number:08d}.jsonl": chunk for chunk in chunks}
    tick(sum(len(chunk) for path, chunk in parts.items() if path.exists()))
    waiting = {path: chunk for path, chunk in parts.items() if not path.exists()}
    made = spread_patches(recipe, waiting, out, scheduler) if scheduler else _run(recipe, waiting, out, workers)
    for path, lines in made:
        write_text(path, "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines))
        tick(len(lines))
    with whole_file(out / "manifest.jsonl") as manifest:
        manifest.write_bytes(b"".join(path.read_bytes() for path in parts))
        summary = _read_summary(manifest)
    shutil.rmtree(out / "parts")
    return summary


def _run(
    recipe: DatasetRecipe, waiting: dict[Path, list[Window]], out: Path, workers: int
) -> Iterator[tuple[Path, list[Line]]]:
    if workers == 1 or len(waiting) < 2:
        for path, chunk in waiting.items():
            yield path, make_patches(recipe, chunk, out)
        return
    # spawn: a forked copy of torch's thread pools can hang
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, MOST_PROCESSES), mp_context=context) as pool:
        jobs = {pool.submit(make_patches, recipe, chunk, out): path for path, chunk in waiting.items()}
        try:
            for job in as_completed(jobs):
                yield jobs[job], job.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _check_folder(recipe: DatasetRecipe, out: Path, resume: bool) -> None:
    path, wanted = out / "recipe.json", json.dumps(recipe.to_json(), indent=1, sort_keys=True) + "\n"
    if not path.exists():
        write_text(path, wanted)
        return
    same = path.is_file() and path.read_bytes() == wanted.encode()
    got = "this dataset" if same else "another dataset"
    if got == "another dataset" or not resume:
        remedy = "add --resume or choose another folder" if got == "this dataset" else "choose another folder"
        raise OptionError("--out", expected="a folder without a dataset", got=got, remedy=remedy)


def _chunks(windows: list[Window]) -> Iterator[list[Window]]:
    for first in range(0, len(windows), CHUNK):
        yield windows[first : first + CHUNK]


def _read_summary(path: Path) -> dict[str, float]:
    """Patches, and the share of SNR pairs that were drawn again.

    Raises:
        OptionError: no manifest of ours.
    """
    try:
        lines: list[Any] = [parse_json(line) for line in path.read_text(encoding="utf-8").split("\n") if line]
        rejected = sum(int(line[role]["rejected_snr_pairs"]) for line in lines for role in ("degraded", "reference"))
        return {"patches": len(lines), "rejected_share": rejected / (rejected + 2 * len(lines))}
    except (ArithmeticError, LookupError, OSError, TypeError, ValueError) as error:
        got, remedy = " ".join(str(error).split())[:120], "choose another --out"
        raise OptionError(str(path), expected="a dataset's manifest", got=got, remedy=remedy) from error
