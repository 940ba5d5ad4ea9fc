"""`restore --dry-run`: the facts of an image file, the plan of its tiles and the time it takes.

Only strips of the image are read, to search them for faults of detectors, and windows if a sensor
is named, to compare them with it. The time on this machine is predicted from tiles that are timed
here; the time on the board is predicted by the cost model.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from beers_deploy.dpu.board import dpu_of
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.network import Network
from beers_deploy.performance.swath import predict_network, swath_latency
from beers_deploy.profiles.errors import BeersError, ImageError
from beers_deploy.profiles.figures import Figure, Row, measured, predicted, unavailable
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.restoration.detectors.fault_list import FOUND
from beers_deploy.restoration.detectors.strips import warn_of_detectors
from beers_deploy.restoration.memory import check_memory, rows_bytes
from beers_deploy.restoration.plan import Plan, plan_for
from beers_deploy.restoration.prepare import NetworkPipeline
from beers_deploy.restoration.radiometry import FullScale, Reading, full_scale_of
from beers_deploy.restoration.runtime import Engine, open_runtime, tiles_at_once
from beers_deploy.restoration.sensor_check.check import SensorCheck, checked_sensor
from beers_deploy.restoration.steps import exposures_of, keeps_pixels

HEADER = "the file's own header"
RUNS = 3


def preview_row(
    image: Path,
    pipeline: NetworkPipeline,
    reading: Reading,
    target: TargetProfile,
) -> Row:
    """Describe what `restore` would do to an image, and predict how long it would take.

    Args:
        image: the image file.
        pipeline: the network and options that would restore it.
        reading: the options by which its pixels are interpreted, such as full scale.
        target: the board whose time is predicted.

    Returns:
        A row with the size, the tiles, the predicted times here and on the board, the faults of
        detectors that were found, where the image lies, and the exposures of the network.

    Raises:
        MachineError: the memory is too small for the run.
    """
    network = next(iter(pipeline.networks.values()))
    with open_raster(image, reading.force) as source:
        raster = source.raster
        plan = plan_for(network, raster.shape, pipeline.tiles)
        check_memory(rows_bytes(source, plan), reading.memory_bytes)
        scale = header_scale(image.name, raster, reading)
        check = SensorCheck()
        # Where full scale is open, no pixel counts as saturated.
        saturation = scale.value if isinstance(scale, FullScale) else math.inf
        detectors = warn_of_detectors(source, saturation, reading.fix_detectors != FOUND)
        if isinstance(scale, FullScale):
            check = checked_sensor(source, reading.sensors, scale.value, str(image), reading.strict)
    figures = {
        "width": measured(raster.width_px, "px", HEADER),
        "height": measured(raster.height_px, "px", HEADER),
        "bands": measured(raster.bands, "1", HEADER),
        **plan.figures,
        "time here": time_here(network, plan, pipeline.engine),
        f"time on {target.name}": time_on_board(network, plan, target),
        **check.figures,
        **detectors,
    }
    open_scale = {"full scale": "open", "full scale from": str(scale)}
    missing = [] if raster.nodata is None else [f"{raster.nodata:g}"]
    if raster.mask_kind:
        missing.append(f"where its {raster.mask_kind} is 0")
    text = {
        "pixels": str(raster.dtype),
        **(scale.text if isinstance(scale, FullScale) else open_scale),
        **place_words(raster),
        "nodata": ", ".join(missing) or "none",
        "halo": plan.halo_words,
        **check.text,
    }
    factors = sorted({1.0, *exposures_of(network, pipeline.around)})
    if len(factors) > 1:
        # Only the pixels tell which tiles need several, and a dry run does not read them all.
        words = ", ".join(f"x{factor:g}" for factor in factors)
        text["exposures"] = f"{words}; the times count one for each tile"
    return Row("restore", image.name, figures, text)


def header_scale(name: str, raster: Raster, reading: Reading) -> FullScale | str:
    """Determine full scale, the pixel value that is 1.0 to a network, without reading pixels.

    Args:
        name: the name of the file, for messages.
        raster: the facts of the file's header.
        reading: the options of the user.

    Returns:
        The full scale, or as text the reason why only the pixels can decide it.
    """
    if raster.dtype.kind == "f" and reading.full_scale is None:
        return (
            "the pixels decide when they are read: digital numbers if one is above 2, else "
            "state the full scale"
        )
    try:
        return full_scale_of(name, raster, (), reading)
    except ImageError:
        # Only 8-bit integers leave full scale open.
        return "8-bit pixels do not tell it; state the pixel value that is full scale"


def place_words(raster: Raster) -> Mapping[str, str]:
    """Return the georeference of an image in words: coordinate system, first corner, pixel size.

    Returns:
        The texts "georeference" and "rational polynomials" of a row, each "none" if absent.
    """
    georeference = raster.georeference
    words = "none"
    if georeference.crs or georeference.transform or georeference.gcps:
        words = "no coordinate system"
        if georeference.crs:
            code = georeference.crs.to_epsg()
            words = f"EPSG:{code}" if code else "a coordinate system without a code"
    if georeference.transform:
        corner = georeference.transform
        words += (
            f", first corner ({corner.c:.9g}, {corner.f:.9g}), pixels of {abs(corner.a):.9g} x "
            f"{abs(corner.e):.9g}"
        )
    if georeference.gcps:
        words += f", {len(georeference.gcps)} ground control points"
    return {"georeference": words, "rational polynomials": "yes" if georeference.rpcs else "none"}


def time_here(network: Network, plan: Plan, engine: Engine) -> Figure:
    """Predict the time of all tiles on this machine, from RUNS timed runs of one tile of noise.

    Reading and writing are not counted, because they run in parallel.

    Args:
        network: the network.
        plan: the tiles of the image.
        engine: the runtime and the number of threads.

    Returns:
        The time in s from the median of the runs. The ends of its interval come from the quickest
        and the slowest run.
    """
    at_once = tiles_at_once(engine.threads, plan.tiles)
    infer, runtime = open_runtime(engine.runtime, network.model, engine.threads)
    shape = (1, plan.tiling.channels_in, *plan.tile_shape)
    tile = np.random.default_rng(0).random(shape, np.float32)
    # The first run also prepares the network, so it is not timed.
    infer(tile)
    times = []
    for _ in range(RUNS):
        started = perf_counter()
        infer(tile)
        times.append((perf_counter() - started) * plan.tiles)
    threads = f"every thread ({at_once} at a time in a run)"
    how = f"{RUNS} runs of one tile with {threads}, {runtime}, times the tiles, one exposure each"
    return predicted(median(times), "s", (min(times), max(times)), how)


def time_on_board(network: Network, plan: Plan, target: TargetProfile) -> Figure:
    """Predict the time of all tiles on a board's DPU by the cost model, in whole batches.

    Each tile counts once, as if no pixel needed another exposure. The board's processor computes
    the consistency step (block means agree with the raw image) if the network retains the image
    size and the bands.

    Args:
        network: the network.
        plan: the tiles of the image.
        target: the board, in its default configuration.

    Returns:
        The time in s; unavailable with the reason if the network does not run on the DPU.
    """
    step_px = (
        plan.height_px * plan.width_px * plan.bands / plan.tiles
        if keeps_pixels(plan.tiling)
        else 0.0
    )
    try:
        tile_px = max(plan.tile_shape)
        prediction = predict_network(network, dpu_of(target), tile_px, step_px=step_px)
    except BeersError as error:
        return unavailable("s", f"no prediction by the cost model: {error}")
    return swath_latency(prediction, math.ceil(plan.tiles / prediction.batch))
