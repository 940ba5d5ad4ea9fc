"""`--runtime auto`: which runtime, how large tiles, and how many at a time, by a short measurement kept in the cache.

The bytes of the output are those of onnxruntime with usual tiles, whatever is chosen. Tiles of another size are tried
only where seams are exact; an image restored in any such tiles is the whole image's. Another runtime is tried only
for INT8 networks, whose sums are whole numbers: a float network differs between runtimes in its last bits. And a
candidate whose result of the measured tiles is not onnxruntime's, bit for bit, is never chosen.
"""

import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from math import ceil, prod
from typing import Any, Self

import numpy as np
import onnx

from deploy.cache import Cache, code_digest
from deploy.networks import Say, cache_folder
from deploy.restoration.engine import Restorer, Strip
from deploy.restoration.options import TILE_PX, Options, Runtime
from deploy.restoration.plan import Plan, Span, plan_for
from deploy.restoration.runtime import Infer, lanes_for, open_runtime, tiles_at_once
from deploy.restoration.source import Raster
from model.io.files import require_writable
from model.io.images import MAX_DN
from model.processor import processor_name
from profiles.errors import ModelError, OptionError
from profiles.figures import Figure, measured
from quant.onnx_file import is_quantised

KIND = "runtime"
"""What a kept choice is called in the cache."""

SIDES_PX = (320, 448, 896)
"""Sides of tiles that are tried beside the usual one."""
FLOAT_LEAST_PX = TILE_PX
"""Of float networks: for small maps a runtime may add in another order (docs/explanation/tiling.md)."""

WALL, PROCESSOR = "the wall's clock", "processor time"
"""What times are compared by. Where others use the cores, the wall's clock tells of them."""

ROUNDS = 8
"""Of a measurement, the first of which warms up."""
TIE = 1.03
"""Candidates that differ by less are told apart by lanes: reading, packing and writing pass unseen beside more."""
BUSY = 1.3
"""Where even the best candidate waits for so many times what its cores computed, others compute on them too."""
HOPELESS = 1.3
"""A candidate so many times slower than the best one is not measured again."""
MEASURE_S = 10.0
"""After so long no candidate is begun and no further round: each of two races takes little longer."""


@dataclass(frozen=True)
class Setting:
    """How a network is run: by which runtime, the longest side of a tile, and tiles in work at a time."""

    runtime: Runtime
    tile_px: int
    lanes: int

    def __str__(self) -> str:
        """In words for the user."""
        return f"{self.runtime}, tile {self.tile_px}, {self.lanes} lane{'s' if self.lanes > 1 else ''}"


@dataclass(frozen=True)
class Choice:
    """The best setting and the usual one, each with megapixels of the image a second, by which clock."""

    best: Setting
    best_mpx_s: float
    usual: Setting
    usual_mpx_s: float
    clock: str

    def __str__(self) -> str:
        """In one sentence for the user."""
        rates = f"measured {self.best_mpx_s:.3g} against {self.usual_mpx_s:.3g} Mpx/s"
        return f"runtime auto: {self.best}: {rates} of {self.usual}{self._by}"

    def figures(self) -> dict[str, Figure]:
        """Both rates."""
        how = f"on tiles of noise in memory, before this run or an earlier one of the same image size{self._by}"
        return {
            "rate as chosen": measured(self.best_mpx_s, "Mpx/s", f"{self.best}; {how}"),
            "rate as usual": measured(self.usual_mpx_s, "Mpx/s", f"{self.usual}; {how}"),
        }

    @property
    def _by(self) -> str:
        return "" if self.clock == WALL else f", by {self.clock}: others used the cores too"

    def to_json(self) -> Mapping[str, object]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """The inverse; raises KeyError, TypeError or ValueError on anything else."""
        best, usual = (_setting(stored[name]) for name in ("best", "usual"))
        return cls(best, float(stored["best_mpx_s"]), usual, float(stored["usual_mpx_s"]), str(stored["clock"]))


def _setting(stored: Mapping[str, Any]) -> Setting:
    return Setting(Runtime(stored["runtime"]), int(stored["tile_px"]), int(stored["lanes"]))


def settled(
    network: onnx.ModelProto, shape: tuple[int, int, int], options: Options, say: Say
) -> tuple[Options, dict[str, Figure]]:
    """Options to restore an image of `shape` (bands, H, W) with, and the rates that decided; `auto` is settled.

    The choice is the one kept for this processor, these versions of the runtimes, this network, the image's size and
    what the options leave open; or it is measured now and kept. Where tile or halo are the user's, only runtime and
    lanes are chosen; under a memory budget no tile is larger than the usual one.

    Raises:
        OptionError: options that fit no plan.
        ModelError: a network that cannot be tiled or run.
        MachineError: the cache cannot be written.
    """
    if options.runtime is not Runtime.auto:
        return options, {}
    choice = _kept(network, shape, options)
    say(str(choice))
    best = choice.best
    return replace(options, runtime=best.runtime, tile_px=best.tile_px, lanes=best.lanes), choice.figures()


def require_one_process(options: Options) -> None:
    """Refuse to choose for workers: they may have other processors, and share their cores.

    Raises:
        OptionError: auto beside workers.
    """
    if options.runtime is Runtime.auto and options.is_spread:
        remedy = "name the runtime, or leave --workers and --scheduler out"
        raise OptionError("--runtime", expected="one by name beside workers", got="auto", remedy=remedy)


def _kept(network: onnx.ModelProto, shape: tuple[int, int, int], options: Options) -> Choice:
    cache, key = Cache(cache_folder()), _key(network, shape, options)
    found = cache.find(KIND, key, Choice)
    if found is None:
        require_writable(cache.path(KIND, key))
        found = _measure(network, shape, options)
        cache.keep(KIND, key, found)
    return found


def _key(network: onnx.ModelProto, shape: tuple[int, int, int], options: Options) -> dict[str, object]:
    return {
        "processor": processor_name(),
        "versions": {each.value: _version(each) for each in (Runtime.onnxruntime, Runtime.openvino)},
        "network": sha256(network.SerializeToString(deterministic=True)).hexdigest(),
        "shape": shape,
        "options": [options.tile_px, options.halo, options.memory_bytes is not None],
        "threads": options.threads or os.cpu_count(),
        "code": code_digest(__name__),
    }


def _version(runtime: Runtime) -> str | None:
    """Of the installed package; None without one."""
    try:
        return version(runtime.value)
    except PackageNotFoundError:
        return None


def _measure(network: onnx.ModelProto, shape: tuple[int, int, int], options: Options) -> Choice:
    """First runtimes and lanes with the usual tile, then other tiles with the best of them."""
    race = Race(network, shape, options)
    plan = race.plan(options.tile_px)
    usual = Setting(Runtime.onnxruntime, plan.tile_px, tiles_at_once(options.threads, plan.tiles))
    times_s, clock = race.times_s([usual, *_ways(usual, plan, network, options.threads)])
    best = _best(times_s)
    sides = list(_sides(best, plan, race))
    if sides:  # the usual one again: the times of two races differ by what else the machine did
        times_s, clock = race.times_s([usual, best, *sides])
        best = _best(times_s)
    pixels = prod(shape) / 1e6
    return Choice(best, pixels / times_s[best], usual, pixels / times_s[usual], clock)


def _best(times_s: Mapping[Setting, float]) -> Setting:
    """The fastest; of those as good as tied, the fastest with the most lanes."""
    tied = [each for each in times_s if times_s[each] <= TIE * min(times_s.values())]
    return min(tied, key=lambda each: (-each.lanes, times_s[each]))


def _ways(usual: Setting, plan: Plan, network: onnx.ModelProto, threads: int) -> Iterator[Setting]:
    """The runtimes that may be taken, each with fewer and more lanes."""
    may_differ = _version(Runtime.openvino) is not None and is_quantised(network)
    for runtime in (Runtime.onnxruntime, Runtime.openvino) if may_differ else (Runtime.onnxruntime,):
        for lanes in lanes_for(threads, plan.tiles):
            yield replace(usual, runtime=runtime, lanes=lanes)


def _sides(best: Setting, usual: Plan, race: "Race") -> Iterator[Setting]:
    """Other sides of tiles that make other plans of the same bytes."""
    options, seen = race.options, {usual.tile_shape}
    if options.tile_px is not None or usual.tiling.fixed_px is not None or usual.halo_px < usual.radius_px:
        return
    least_px = 0 if is_quantised(race.network) else FLOAT_LEAST_PX
    most_px = TILE_PX if options.memory_bytes is not None else max(SIDES_PX)
    for side_px in (each for each in SIDES_PX if least_px <= each <= most_px):
        with suppress(OptionError):  # no room between the halos
            plan = race.plan(side_px)
            if plan.tile_shape not in seen:
                seen.add(plan.tile_shape)
                yield replace(best, tile_px=side_px)


@dataclass
class Trial:
    """A setting ready to run.

    Attributes:
        setting: of the trial.
        restorer: of images as large as one tile.
        strip: such an image, of noise.
        batches: of as many tiles as are in work at a time, that the image takes.
        opened_s: what opening the network took, by the wall and by the processor.
        times_s: of each batch that was run, by both clocks; the first one warmed up.
    """

    setting: Setting
    restorer: Restorer
    strip: Strip
    batches: int
    opened_s: tuple[float, float]
    times_s: list[tuple[float, float]]

    @property
    def total_s(self) -> tuple[float, float]:
        """Of the whole image, opening and warming up included, by the wall and by the processor."""
        first, fastest = np.array(self.times_s[0]), np.min(self.times_s[1:] or self.times_s, axis=0)
        wall_s, processor_s = self.opened_s + np.maximum(first - fastest, 0) + fastest * self.batches
        return float(wall_s), float(processor_s)

    def run(self) -> None:
        """One batch, each tile in a thread of its own, from stored pixels to stored pixels, as the engine runs it."""
        _, height_px, width_px = self.strip.pixels.shape
        rows, columns = Span(0, height_px, 0, height_px), Span(0, width_px, 0, width_px)
        tiles = range(self.setting.lanes)
        with ThreadPoolExecutor(self.setting.lanes) as pool:
            taken = _Stopwatch()
            deque(pool.map(lambda _: self.restorer.tile(self.strip, 0, rows, columns), tiles), maxlen=0)
            self.times_s.append(taken.seconds())

    def gives_what(self, infer: Infer) -> bool:
        """Whether the network makes of the strip what another makes of it, bit for bit."""
        image = self.strip.pixels[None] / np.float32(MAX_DN)
        return np.array_equal(self.restorer.infer(image), infer(image))


class _Stopwatch:
    """Runs from where it is made."""

    def __init__(self) -> None:
        self._begun = time.perf_counter(), time.process_time()

    def seconds(self) -> tuple[float, float]:
        """So far, by the wall and by the processor."""
        return time.perf_counter() - self._begun[0], time.process_time() - self._begun[1]


@dataclass(frozen=True)
class Race:
    """What is to be restored: settings race each other on it."""

    network: onnx.ModelProto
    shape: tuple[int, int, int]
    options: Options

    def plan(self, tile_px: int | None) -> Plan:
        """How the image is cut with such tiles."""
        return plan_for(self.network, self.shape, replace(self.options, tile_px=tile_px))

    def times_s(self, settings: Iterable[Setting]) -> tuple[dict[Setting, float], str]:
        """Seconds that the whole image takes in each setting, interleaved, and by which clock.

        Settings that cannot run it, or whose result is not onnxruntime's bit for bit, are left out; the first one is
        onnxruntime's.
        """
        begun, trials = time.perf_counter(), list[Trial]()
        usual, _ = open_runtime(Runtime.onnxruntime, self.network, self.options.threads)
        for setting in dict.fromkeys(settings):
            if not trials or time.perf_counter() - begun < MEASURE_S:
                trials += self._warm(setting, usual)
        racing = trials
        for _ in range(1, ROUNDS):
            if time.perf_counter() - begun < MEASURE_S:
                for trial in racing:
                    trial.run()
                times_s, _ = self._compared(racing)
                least_s = HOPELESS * min(times_s.values())
                racing = [trial for trial in racing if times_s[trial.setting] <= least_s]
        return self._compared(trials)

    def _compared(self, trials: Iterable[Trial]) -> tuple[dict[Setting, float], str]:
        """Times by the wall's clock; where others use the cores too, what the processor's would be without them."""
        cores = self.options.threads or os.cpu_count() or 1
        wall = {trial.setting: trial.total_s[0] for trial in trials}
        processor = {trial.setting: trial.total_s[1] / cores for trial in trials}
        if all(wall[each] > BUSY * processor[each] for each in wall):
            return processor, PROCESSOR
        return wall, WALL

    def _warm(self, setting: Setting, usual: Infer) -> list[Trial]:
        """A setting after its first run; none where the runtime refuses the network, or gives other bits."""
        plan = self.plan(setting.tile_px)
        raster = Raster(plan.tiling.channels_in, *plan.tile_shape, np.dtype(np.uint16))
        noise = np.random.default_rng(0).integers(0, MAX_DN + 1, raster.shape, np.uint16)
        try:
            taken = _Stopwatch()
            infer, _ = open_runtime(setting.runtime, self.network, self.options.threads, setting.lanes)
            opened_s, restorer = taken.seconds(), Restorer(raster, infer, float(MAX_DN), plan.tiling)
            trial = Trial(setting, restorer, Strip(0, noise, None), ceil(plan.tiles / setting.lanes), opened_s, [])
            trial.run()
            return [trial] if trial.gives_what(usual) else []
        except ModelError:
            if setting.runtime is Runtime.onnxruntime:
                raise
            return []
