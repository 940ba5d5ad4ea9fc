"""Write datasets of simulated pairs: TIFF patches and a manifest, in parallel, resumable and
reproducible byte for byte.

The pixels of a patch depend on the recipe and its number only, not on the process that makes it.
The recipe is stored next to the pairs, so that a reader knows which sensors and scenes they come
from.
"""

import json
import logging
import math
import multiprocessing
import shutil
import signal
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from itertools import chain, groupby, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beers_deploy.model.io.files import sha256, write_text
from beers_deploy.model.manifest import DIGESTS, ROLES, Line, image_of, line_text, matching_lines
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.model.simulator.acquire import prepare_scene, scene_side_px, simulate_planned
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.plan import TOLERANCE_DN, make_plan
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene, read_scene, resample
from beers_deploy.profiles.errors import ImageError, MachineError, OptionError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.user_files.json_text import parse_json

logger = logging.getLogger(__name__)

DRAWN_SIDE_PX = 3000


@dataclass(frozen=True)
class DatasetRecipe:
    """The parameters that determine the pixels of a dataset of simulated pairs.

    Attributes:
        scenes: the files of the scenes; None is a scene that is drawn from the seed.
        degraded: the sensor of the images to restore.
        reference: the sensor of the images that a restoration aims at, in the units of `degraded`.
        oversampling: the number of scene pixels per pixel of a pair, along each side.
        patch_px: the side of a pair in pixels; None takes whole scenes.
        radiance_scale: a factor on the radiance of every scene.
        seed: the seed of drawn scenes, sensors and noise.
        tolerance_dn: the simulator leaves out effects that change no pixel by more, in DN.
        scene_scale: a factor on the size of every scene, if the wanted ratio is not an integer.
    """

    scenes: tuple[Path | None, ...]
    degraded: Sensor
    reference: Sensor
    oversampling: int
    patch_px: int | None
    radiance_scale: float = 1.0
    seed: int = 0
    tolerance_dn: float = TOLERANCE_DN
    scene_scale: float = 1.0

    def to_json(self) -> dict[str, object]:
        """Return the recipe as it is stored in a file; scenes are stored by name and digest."""
        scenes = [
            {"name": p.name, "sha256": sha256(p)} if p else {"name": "drawn"} for p in self.scenes
        ]
        return asdict(self) | {"scenes": scenes}


@dataclass(frozen=True)
class Window:
    """The position of one patch in a scene.

    Attributes:
        number: the number of the patch in the dataset.
        scene: the index of the scene.
        name: the name of the patch, which its files have.
        top: the first row of the patch with its margin, in scene pixels.
        left: its first column.
        height: its height with the margin, in scene pixels.
        width: its width.
    """

    number: int
    scene: int
    name: str
    top: int
    left: int
    height: int
    width: int


def plan_windows(recipe: DatasetRecipe) -> list[Window]:
    """Plan every patch of a dataset, in order, or raise ImageError that names all scenes which are
    too small.
    """
    windows: list[Window] = []
    small: list[Path | None] = []
    for index, path in enumerate(recipe.scenes):
        scene_windows = list(_scene_windows(recipe, index, len(windows)))
        if not scene_windows:
            small.append(path)
        windows += scene_windows
    if small:
        side = scene_side_px(recipe.patch_px or 1, recipe.oversampling)
        side = math.ceil(side / recipe.scene_scale)
        if small == [None]:
            raise ImageError(
                f"The drawn scene has less than {side} scene pixels a side. Give `images` with "
                "scenes of at least that size."
            )
        names = ", ".join(str(path or "the drawn scene") for path in small)
        raise ImageError(
            f"A scene needs at least {side} scene pixels a side. These have less: {names}. Leave "
            "them out."
        )
    return windows


def _scene_windows(recipe: DatasetRecipe, index: int, first: int) -> Iterator[Window]:
    path = recipe.scenes[index]
    ratio = recipe.oversampling
    sides: tuple[int, ...] = (DRAWN_SIDE_PX, DRAWN_SIDE_PX)
    if path is not None:
        # A scene that cannot be read is refused here. One is only drawn where its pixels are used.
        sides = read_scene(path, recipe.reference.nominal()).radiance.shape
    height, width = (round(side * recipe.scene_scale) for side in sides)
    stem = f"{index:04d}-{path.stem if path else 'drawn'}"
    if recipe.patch_px is None:
        if min(height, width) >= scene_side_px(1, ratio):
            yield Window(first, index, stem, 0, 0, height, width)
        return
    side = scene_side_px(recipe.patch_px, ratio)
    step = recipe.patch_px * ratio
    tops = range(0, height - side + 1, step)
    lefts = range(0, width - side + 1, step)
    for k, (top, left) in enumerate(product(tops, lefts)):
        yield Window(first + k, index, f"{stem}-{k:05d}", top, left, side, side)


def load(recipe: DatasetRecipe, index: int) -> Scene:
    """Load or draw the scene of this index in `recipe.scenes`, and scale its radiance and size."""
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


class Patch(NamedTuple):
    """A pair of images (H, W) uint16, by role, and its line of the manifest."""

    images: dict[str, np.ndarray]
    line: Line


def make_patches(recipe: DatasetRecipe, windows: list[Window]) -> list[Patch]:
    """Simulate the patches of the given windows, which must all lie in one scene."""
    radiance = load(recipe, windows[0].scene).radiance
    patches = []
    for window in windows:
        rows = slice(window.top, window.top + window.height)
        columns = slice(window.left, window.left + window.width)
        part = prepare_scene(radiance[rows, columns], recipe.oversampling)
        draw = Draw(recipe.seed, window.number)
        line, sensors = _drawn(recipe, window)
        images = {}
        for role, sensor in sensors.items():
            plan = make_plan(sensor, part.stats, recipe.tolerance_dn)
            images[role] = to_uint16(simulate_planned(part, sensor, draw, plan, role))
            line[role][PLAN] = plan.to_json()
        patches.append(Patch(images, line))
    return patches


PLAN = "plan"
"""Key of the simulated effects of a role, which depend on the pixels of the scene."""


def _drawn(recipe: DatasetRecipe, window: Window) -> tuple[dict[str, Any], dict[str, Instrument]]:
    """Return a pair's line of the manifest without its plans, and its sensors by role: no pixel
    decides them.
    """
    draw = Draw(recipe.seed, window.number)
    line: dict[str, Any] = {"number": window.number, "name": window.name, "seed": recipe.seed}
    line |= {"source": window.name.split("-", 1)[1], "top_px": window.top, "left_px": window.left}
    sensors = {}
    for role, profile in (("degraded", recipe.degraded), ("reference", recipe.reference)):
        sensors[role], rejected = profile.draw_counted(draw.generator(f"sensor-{role}"))
        # The response is the same for all pairs, and stands in the recipe.
        numbers = asdict(replace(sensors[role], response=None))
        line[role] = {"sensor": numbers, "rejected_snr_pairs": rejected}
    return line, sensors


CHUNK = 32
"""The number of patches per call: small enough to lose little if the run is killed."""
MOST_PROCESSES = 61 if sys.platform == "win32" else 1 << 16
"""The maximum number of processes: on Windows, Python refuses a larger pool."""


def write_dataset(
    recipe: DatasetRecipe,
    out: Path,
    workers: int,
    resume: bool,
    pool: Executor | None = None,
) -> dict[str, float]:
    """Write a dataset of TIFF patches and its manifest.

    Pairs of an earlier run remain if they match the digests in their lines of the manifest; others
    are simulated again.

    Args:
        recipe: the parameters that determine the pixels.
        out: the dataset's folder.
        workers: the number of processes on this host, or of calls that the pool runs at once.
        resume: True to continue a dataset of which the folder contains a part.
        pool: runs the calls instead of processes on this host; only this process writes.

    Returns:
        The number of patches, and the share of drawn SNR pairs that were impossible and redrawn.
    """
    # This comes first, so that a scene that cannot be read is refused before anything is written.
    windows = plan_windows(recipe)
    _check_folder(recipe, out, resume)
    _remove_left_overs(out)
    manifest = out / "manifest.jsonl"
    parts = {out / "parts" / f"{chunk[0].number:08d}.jsonl": chunk for chunk in _chunks(windows)}
    lines = _lines_left(recipe, out, windows, parts) if resume else {}
    waiting = {}
    for path, chunk in parts.items():
        missing = [window for window in chunk if window.number not in lines]
        if missing:
            waiting[path] = missing
    count = min(workers, len(waiting), MOST_PROCESSES)
    executor = nullcontext(pool) if pool or count < 2 else processes(count)
    with steps("simulating", len(windows)) as bar, executor as calls:
        bar.advance(len(lines))
        for path, patches in _patches_by_path(recipe, waiting, workers, calls):
            for window, patch in zip(waiting[path], patches, strict=True):
                for role, dn in patch.images.items():
                    write_tiff(image_of(out, role, window.name), dn)
                lines[window.number] = line_text(out, patch.line)
            write_text(path, "".join(lines[window.number] for window in parts[path]))
            bar.advance(len(patches))
    content = "".join(lines[window.number] for window in windows)
    if not manifest.is_file() or manifest.read_bytes() != content.encode():
        write_text(manifest, content)
    shutil.rmtree(out / "parts", ignore_errors=True)
    rejected = 0
    for text in lines.values():
        line = json.loads(text)
        rejected += sum(line[role]["rejected_snr_pairs"] for role in ROLES)
    return {"patches": len(lines), "rejected_share": rejected / (rejected + 2 * len(lines))}


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Start processes on this host that make patches, and end them.

    Args:
        count: the number of processes.

    Yields:
        The pool of the processes.

    Raises:
        MachineError: a process ended before its work was done.
    """
    # A forked copy of a library's threads can hang.
    spawn = multiprocessing.get_context("spawn")
    # Ctrl-C reaches each process: those of the pool end without a traceback.
    pool = ProcessPoolExecutor(count, spawn, signal.signal, (signal.SIGINT, signal.SIG_DFL))
    try:
        yield pool
    except BrokenProcessPool as error:
        # A process first imports the script that started it. A call that is not guarded there
        # starts processes again, which Python refuses.
        raise MachineError(
            "A worker process ended before its work was done: it was killed, or the script that "
            "called it calls it again on import. Give `workers` 1, or in a script put the call "
            "behind \"if __name__ == '__main__':\"."
        ) from error
    finally:
        # The pool itself must cancel its calls: when its processes end while calls are cancelled
        # from here, its thread fails with a traceback.
        pool.shutdown(cancel_futures=True)


def _chunks(windows: list[Window]) -> Iterator[list[Window]]:
    """Yield the windows of each call, in order: those of one scene, CHUNK at most."""
    for _, group in groupby(windows, key=lambda window: window.scene):
        scene = list(group)
        for first in range(0, len(scene), CHUNK):
            yield scene[first : first + CHUNK]


def _remove_left_overs(out: Path) -> None:
    """Delete the files that a killed run left half-written, by the names of `whole_file`."""
    for folder in (out, out / "parts", *(out / role for role in ROLES)):
        for path in folder.glob(".*.[0-9]*.part"):
            if not path.is_dir():
                path.unlink()


def _lines_left(
    recipe: DatasetRecipe,
    out: Path,
    windows: list[Window],
    parts: Mapping[Path, list[Window]],
) -> dict[int, str]:
    """Return the lines of the pairs that an earlier run wrote and that match, by number; warn of
    the others.
    """
    manifest = out / "manifest.jsonl"
    texts = matching_lines(out, (manifest, *parts))
    lines = {}
    for window in windows:
        text = texts.get((window.number, window.name))
        if text is None:
            continue
        line: Any = parse_json(text)
        del line[DIGESTS]
        for role in ROLES:
            line[role].pop(PLAN, None)
        # The line must state the seed, the place and the sensors that are drawn anew; the plan
        # depends on the pixels of the scene.
        drawn_line, _ = _drawn(recipe, window)
        if json.dumps(line, sort_keys=True) == json.dumps(drawn_line, sort_keys=True):
            lines[window.number] = text
    candidates = windows
    if not manifest.exists():
        begun = [chunk for path, chunk in parts.items() if path.exists()]
        candidates = list(chain.from_iterable(begun))
    damaged = sum(window.number not in lines for window in candidates)
    if damaged:
        logger.warning(
            "%d of %d pairs do not match the digests in the manifest: they are simulated again",
            damaged,
            len(candidates),
        )
    return lines


def _patches_by_path(
    recipe: DatasetRecipe, waiting: dict[Path, list[Window]], workers: int, pool: Executor | None
) -> Iterator[tuple[Path, list[Patch]]]:
    """Yield the patches of each part in order; two calls per worker run at any time."""
    if pool is None:
        for path, chunk in waiting.items():
            yield path, make_patches(recipe, chunk)
        return
    calls: deque[tuple[Path, Future[list[Patch]]]] = deque()
    for path, chunk in waiting.items():
        calls.append((path, pool.submit(make_patches, recipe, chunk)))
        if len(calls) > 2 * workers:
            path, call = calls.popleft()
            yield path, call.result()
    for path, call in calls:
        yield path, call.result()


def _check_folder(recipe: DatasetRecipe, out: Path, resume: bool) -> None:
    path = out / "recipe.json"
    content = json.dumps(recipe.to_json(), indent=1, sort_keys=True) + "\n"
    if not path.exists():
        write_text(path, content)
        return
    present = path.read_bytes() if path.is_file() else b""
    # An editor or Git may have changed how its lines end.
    if present.replace(b"\r\n", b"\n") != content.encode():
        raise OptionError(
            f"`out` must be a folder without a dataset, but {out} holds another dataset. Choose "
            "another folder."
        )
    if not resume:
        raise OptionError(
            f"`out` must be a folder without a dataset, but {out} holds this dataset. Add `resume` "
            "or choose another folder."
        )
    if present != content.encode():
        write_text(path, content)
