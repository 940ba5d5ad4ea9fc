"""The image that a benchmark is about, the tiles that it is cut into, and the figures that are
predicted of it.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from operator import mul

import numpy as np

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.host import FloatWork, Task
from beers_deploy.dpu.cost.latency import Prediction, dpu_power, predict
from beers_deploy.dpu.cost.model import Interval, between
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.model.consistency.step import DETAIL_PRODUCTS_PER_PX, PRODUCTS_PER_PX
from beers_deploy.model.exposure import exposures_for
from beers_deploy.model.raster.facts import SIDE_PX
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Figure, predicted, unavailable
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.quant.encodings import CORE, read_core
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.plan import make_plan, plan_side
from beers_deploy.restoration.tiles.exposures import tiles_by_factor

COST_SOURCE = "cost model fitted on published networks, docs/explanation/cost-model.md"
HELD = 0.9
"""Share of families left out of the fit that an interval is meant to hold."""
ARITHMETIC = "arithmetic of the tile grid"
STEP_SOURCE = (
    "counted work of the step at the rates of the board's processor, from the best published to "
    "plain code"
)
PAPER_SIZE = "13600x9016"


@dataclass(frozen=True)
class Swath:
    """The image that a benchmark describes, and the tiles it is cut into.

    Attributes:
        width_px: the width of the image in pixels.
        height_px: the height of the image in pixels.
        tile_px: side of a tile in pixels, halo included.
        halo_px: pixels at a tile's inner borders that are computed as context and discarded.
        bands: number of bands that a run of the network restores together.
        runs: mean number of runs of the network on a tile: one for each exposure, a factor of
            brightness, that its pixels need.
        consistency: True if the host computes the consistency step, which makes block means of the
            result agree with the raw image.
        detail: True if that step also corrects blocks of 2 x 2 pixels. It does so for a sensor
            whose MTF has another curve than the usual formula.
    """

    width_px: int
    height_px: int
    tile_px: int = TILE_PX
    halo_px: int = 0
    bands: int = 1
    runs: float = 1.0
    consistency: bool = False
    detail: bool = False

    @property
    def pixels(self) -> int:
        """The number of pixels of the image."""
        return self.width_px * self.height_px

    @property
    def band_pixels(self) -> int:
        """Return the number of pixels of all bands, for steps that take the bands one by one."""
        return self.pixels * self.bands

    @property
    def frames(self) -> float:
        """The number of tiles as the paper counts them: the pixels of the image divided by
        those of a tile, a fraction, without halo.

        For 13600 x 9016 pixels in tiles of 640 it is 299.4. At the published 7.2 frames a second
        they take the published 42 s.
        """
        return self.pixels / self.tile_px**2

    @property
    def tiles(self) -> int:
        """The number of whole tiles that cover the image with their halos.

        The last row and column are moved inward to stay in the image. It is 384 for the paper's
        swath with halo 35.
        """
        rows, columns = (
            plan_side(side, self.tile_px, self.halo_px) for side in (self.height_px, self.width_px)
        )
        return len(rows) * len(columns)

    @property
    def step_px(self) -> float:
        """The number of pixels of the consistency step for each run of the network.

        Each band counts. If the step corrects finer detail too, a pixel counts as the number of
        pixels that take as many operations without it. It is 0 without the step.
        """
        if not self.consistency:
            return 0.0
        products = PRODUCTS_PER_PX + (DETAIL_PRODUCTS_PER_PX if self.detail else 0.0)
        return self.band_pixels / (self.tiles * self.runs) * products / PRODUCTS_PER_PX


def exposed(
    swath: Swath, dn: np.ndarray, sensor: Sensor, tiling: Tiling
) -> tuple[Swath, list[str]]:
    """Count the exposures that the tiles of an image need. The network runs once for each.

    Args:
        swath: the image and its tiles.
        dn: digital numbers (H, W) of the image in 0..MAX_DN, whatever the bits of the sensor.
        sensor: the sensor that the network is conditioned on.
        tiling: the network's tiling geometry.

    Returns:
        The swath with its mean number of runs, and a sentence with the share of each exposure (a
        factor by which pixels are multiplied); no sentence if the network has one exposure alone.
    """
    plan = make_plan((1, *dn.shape), swath.tile_px, swath.halo_px, tiling)
    # The board runs the network in INT8.
    instrument = sensor.nominal()
    factors = [exposure.factor for exposure in exposures_for(instrument, int8=True)]
    counts = tiles_by_factor(dn, plan, factors, MAX_DN, instrument.dark_value(MAX_DN))
    total = sum(counts.values())
    shares = ", ".join(f"x{factor:g} {count / total:.0%}" for factor, count in counts.items())
    words = (
        f"runs of the network by exposure, in tiles of {swath.tile_px} (measured on the image's "
        f"pixels): {shares}; one tile may need several"
    )
    return replace(swath, runs=total / plan.tiles), [words] if len(counts) > 1 else []


def predict_network(
    network: NetworkLike,
    dpu: Dpu,
    tile_px: int | None = TILE_PX,
    task: Task | None = None,
    step_px: float = 0.0,
) -> Prediction:
    """Predict a network on a DPU for tiles of one size.

    Args:
        network: the network, or its file or name.
        dpu: the configuration of the DPU.
        tile_px: side of a tile in pixels; None for the size that the network is fixed to.
        task: the host's task with the results; None derives it from the network's operators.
        step_px: pixels of a tile for which the host computes the consistency step; 0 for no step.

    Raises:
        ModelError: the DPU does not run the network as a whole, or the network has no convolution.
    """
    source = Network.load(network, to_run=False)
    sized = sized_graph(source.model, tile_px, source.label)
    return predict(place(sized, dpu), dpu, task, step_px, float_work(source))


def float_work(network: Network) -> FloatWork:
    """Return the work of the host in float on an INT8 network's results; no work for a float
    network, whose operators show it.
    """
    if CORE not in metadata(network.model):
        return FloatWork()
    part = read_core(network.model).host_part
    kinds = (part.base.mode if part.base.factor > 1 else "", part.activation)
    return FloatWork(tuple(filter(None, kinds)), part.decoding.copies)


def swath_figures(
    prediction: Prediction, swath: Swath, frames: float, batches: float
) -> dict[str, Figure]:
    """Compute the figures of a swath from the prediction of a tile.

    Args:
        prediction: the prediction of the network for one tile size.
        swath: the image and its tiles.
        frames: the number of tiles, which may be a fraction.
        batches: the number of batches that the DPU needs for all runs of these tiles.

    Returns:
        Latency in s, throughput in tiles a second, power in W, energy in J and further figures, by
        the name of the column.
    """
    power = dpu_power(prediction.dpu)
    latency = swath_latency(prediction, batches)
    figures = {
        "tiles": exact(frames, "tile", ARITHMETIC),
        "network runs": exact(
            swath.runs, "run/tile", "exposures that the image's tiles ask for; 1 without an image"
        ),
        "work factor": exact(frames * swath.tile_px**2 / swath.pixels, "px/px", ARITHMETIC),
        "latency": latency,
        "throughput": throughput(prediction),
        "power": power,
        "energy": energy(latency, power),
        "efficiency": efficiency(swath.pixels, latency, power),
    }
    if swath.consistency:
        # All cores of the processor compute the step while the DPU works, so the latency does not
        # grow by the whole of this time.
        runs = swath.tiles * swath.runs
        low_s, high_s = (end_s * runs for end_s in prediction.step_s)
        figures["consistency step"] = predicted(
            between((low_s, high_s)), "s", (low_s, high_s), STEP_SOURCE
        )
    # How many times as fast as the shipped model states the owner's runs make the prediction.
    if prediction.dpu.runs:
        figures["your runs"] = exact(prediction.speed, "x", "your runs, weighed by kinship")
    return figures


def throughput(prediction: Prediction) -> Figure:
    """Return the predicted rate of the DPU and the host together, in tiles per second."""
    return predicted(prediction.fps, "frame/s", prediction.fps_interval, COST_SOURCE)


def host_time(prediction: Prediction, unit: str) -> Figure:
    """Return the time in ms that all cores of the host need for one input of the network.

    Args:
        prediction: the prediction of the network.
        unit: the unit that the figure states, "ms/tile" or "ms/frame".
    """
    low_s, high_s = prediction.host_interval_s
    return predicted(1e3 * prediction.host_s, unit, (1e3 * low_s, 1e3 * high_s), COST_SOURCE)


def one_thread_latency(prediction: Prediction) -> Figure:
    """Return the time in ms from input to result if one thread runs a batch on one core of the DPU,
    and then the host's work for it.
    """
    low_s, high_s = prediction.latency_interval_s
    handlers = prediction.dpu.handlers
    images = f"a batch of {handlers}" if handlers > 1 else "one image"
    how = f"its fit to rates with one thread: {images} through one core, then the host"
    source = f"{COST_SOURCE}, {how}"
    return predicted(1e3 * prediction.latency_s, "ms/batch", (1e3 * low_s, 1e3 * high_s), source)


def swath_latency(prediction: Prediction, batches: float) -> Figure:
    """Predict the time in s that a DPU and its host need for a number of batches.

    Args:
        prediction: the prediction of the network. A batch is the images that the DPU computes at
            once.
        batches: the number of batches, which may be a fraction.
    """
    images = batches * prediction.batch
    # The lower end of the rate is the upper end of the time.
    slow_s, fast_s = (images / fps for fps in prediction.fps_interval)
    return predicted(images / prediction.fps, "s", (fast_s, slow_s), COST_SOURCE)


def fitted_range(prediction: Prediction) -> str:
    """State whether a network is within the range of those that the cost model was fitted to.

    Returns:
        "inside", or "outside" with the properties. If the board's intervals contained fewer than
        HELD of the families of networks that were left out of the fit, the text adds the share.
    """
    words = f"outside: {'; '.join(prediction.outside)}" if prediction.outside else "inside"
    share = prediction.dpu.value("cost", "families_held")
    if share >= HELD:
        return words
    return f"{words}; intervals held {100 * share:.0f} % of families left out"


def energy(latency: Figure, power: Figure) -> Figure:
    """Return the energy in J of a run, from its time in s and its power in W."""
    return _of_time_and_power(latency, power, "J", mul)


def efficiency(pixels: int, latency: Figure, power: Figure) -> Figure:
    """Return the pixels per second and watt.

    Args:
        pixels: the number of pixels of the image.
        latency: the time of the image in s.
        power: the power in W.
    """
    return _of_time_and_power(
        latency, power, "px/s/W", lambda time_s, power_w: pixels / time_s / power_w
    )


def _of_time_and_power(
    latency: Figure, power: Figure, unit: str, compute: Callable[[float, float], float]
) -> Figure:
    """Compute a figure from time and power. Its interval pairs the fastest run with the lowest
    power, and the slowest run with the highest power.
    """
    if power.value is None or latency.value is None:
        return unavailable(unit, power.reason or latency.reason)
    low, high = sorted(map(compute, interval_ends(latency), interval_ends(power)))
    source = f"{latency.source}; {power.source}"
    return predicted(compute(latency.value, power.value), unit, (low, high), source)


def interval_ends(figure: Figure) -> Interval:
    """Return the interval of a figure; (value, value) if it has none, with 0 for no value."""
    return figure.interval or (figure.value or 0.0, figure.value or 0.0)


def pipeline_rate(swath: Swath, latency: Figure) -> Figure:
    """Return the rate of the traditional pipeline in tiles per second, as the paper counts them.

    It is the pixels of the swath over those of a tile without halo, over the time.

    Args:
        swath: the image and its tiles.
        latency: the predicted time of the swath in s.
    """
    low, high = (swath.frames / end_s for end_s in reversed(interval_ends(latency)))
    return predicted(
        swath.frames / (latency.value or math.inf), "frame/s", (low, high), latency.source
    )


def exact(
    value: float, unit: str, source: str = "arithmetic of the graph's shapes, one image"
) -> Figure:
    """Build a figure that follows from shapes alone, so that its interval has no width."""
    return predicted(value, unit, (value, value), source)


def scaled(value: float, unit: str, prediction: Prediction) -> Figure:
    """Build a figure for a part of a prediction, such as the time of a layer.

    Args:
        value: the value of the part.
        unit: its unit.
        prediction: the whole prediction, whose relative error the part is given.
    """
    return predicted(
        value, unit, (value / prediction.spread, value * prediction.spread), COST_SOURCE
    )


def parse_size(size: str | tuple[int, int]) -> tuple[int, int]:
    """Parse the option `size` of `bench`.

    Args:
        size: a pair (width, height) in pixels, or text WIDTHxHEIGHT.

    Returns:
        (width, height) in pixels.

    Raises:
        OptionError: the text has another form, or a side is not from 1 to SIDE_PX.
    """
    several = isinstance(size, Iterable) and not isinstance(size, str)
    text = "x".join(map(str, size)) if several else str(size)
    parts = text.lower().split("x")
    # Python raises an error of its own for very long numbers, so these are refused by their length.
    if len(parts) != 2 or not all(
        part.isdecimal() and len(part) <= 9 and 0 < int(part) <= SIDE_PX for part in parts
    ):
        raise OptionError(
            f"`size` must be WIDTHxHEIGHT of 1 to {SIDE_PX} pixels each, got "
            f"{printable(repr(size))}. Write it as {PAPER_SIZE}."
        )
    return int(parts[0]), int(parts[1])
