"""`restore --dry-run`: what the tool makes of an image file, before anyone waits for it.

Of a TIFF only strips are read, which are searched for faults of detectors, and windows where a
sensor is told, which are held against it. Time here is predicted only from tiles that were timed;
time on the board is the cost model's.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from beers_deploy.bench.swath import predict_network, swath_latency
from beers_deploy.dpu.board import dpu_of
from beers_deploy.model.progress import Log, no_log
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.network import Network
from beers_deploy.profiles.errors import BeersError, ImageError
from beers_deploy.profiles.figures import Figure, Row, measured, predicted, unavailable
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.restoration.detectors.words import warn_of_detectors
from beers_deploy.restoration.figures import plan_figures
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.plan import Plan, plan_for
from beers_deploy.restoration.radiometry import FullScale, full_scale_of
from beers_deploy.restoration.runtime import open_runtime, tiles_at_once
from beers_deploy.restoration.sensor_check import SensorCheck, told_sensor
from beers_deploy.restoration.steps import keeps_pixels

HEADER = "the file's own header"
RUNS = 3
UNTIMED = "no tile was timed here"


def preview_row(
    image: Path, options: Options, target: TargetProfile, measure: bool = True, log: Log = no_log
) -> Row:
    """The facts of an image and of its restoration.

    Args:
        image: its file.
        options: as a restoration would be given them.
        target: the board whose time is predicted.
        measure: whether tiles are timed here.
        log: is told of faults of detectors, and where the image contradicts its sensor.
    """
    network = Network.load(options.network)
    with open_raster(image, options.force) as source:
        raster = source.raster
        scale = known_scale(image.name, raster, options)
        check = SensorCheck()
        # Where full scale is open, no pixel counts as saturated.
        saturation = scale.value if isinstance(scale, FullScale) else math.inf
        detectors = warn_of_detectors(source, saturation, log)
        if isinstance(scale, FullScale):
            check = told_sensor(
                source, options.sensors, scale.value, str(image), options.strict, log
            )
    plan = plan_for(network, raster.shape, options)
    figures = {
        "width": measured(raster.width_px, "px", HEADER),
        "height": measured(raster.height_px, "px", HEADER),
        "bands": measured(raster.bands, "1", HEADER),
        **plan_figures(plan),
        "time here": time_here(network, plan, options) if measure else unavailable("s", UNTIMED),
        f"time on {target.name}": time_on_board(network, plan, target),
        **check.figures,
        **detectors,
    }
    open_scale = {"full scale": "open", "full scale from": str(scale)}
    text = {
        "pixels": str(raster.dtype),
        **(scale.text if isinstance(scale, FullScale) else open_scale),
    }
    text |= {
        **place_words(raster),
        "nodata": missing_words(raster),
        "halo": plan.halo_words,
        **check.text,
    }
    return Row("restore", image.name, figures, text)


def missing_words(raster: Raster) -> str:
    """Which pixels are missing: those of the nodata value, and those that a mask or alpha hides."""
    hidden = [f"where its {raster.mask_kind} is 0"] if raster.mask_kind else []
    valued = [] if raster.nodata is None else [f"{raster.nodata:g}"]
    return ", ".join([*valued, *hidden]) or "none"


def known_scale(name: str, raster: Raster, options: Options) -> FullScale | str:
    """Full scale as far as no pixel is read; else why it is open."""
    if raster.dtype.kind == "f" and options.full_scale is None:
        return (
            "the pixels decide when they are read: digital numbers if one is above 2, else "
            "state the full scale"
        )
    try:
        return full_scale_of(name, raster, (), options.full_scale, options.sensor_bits)
    except ImageError as error:
        return f"{error.got}; state the pixel value that is full scale"


def place_words(raster: Raster) -> Mapping[str, str]:
    """Return where the image lies, in words."""
    place = raster.place
    words = "none"
    if place.crs or place.transform or place.gcps:
        words = _crs_name(place.crs)
    if place.transform:
        corner = place.transform
        words += (
            f", first corner ({corner.c:.9g}, {corner.f:.9g}), pixels of {abs(corner.a):.9g} x "
            f"{abs(corner.e):.9g}"
        )
    if place.gcps:
        words += f", {len(place.gcps)} ground control points"
    return {"georeference": words, "rational polynomials": "yes" if place.rpcs else "none"}


def _crs_name(crs: Any) -> str:
    """Return the EPSG code of a coordinate system, if it has one."""
    code = crs.to_epsg() if crs else None
    return f"EPSG:{code}" if code else "a coordinate system without a code"


def time_here(network: Network, plan: Plan, options: Options) -> Figure:
    """The time of all tiles, from those timed here; reading and writing are done beside it.

    The interval is of the quickest and the slowest of the runs.
    """
    at_once = tiles_at_once(options.threads, plan.tiles)
    infer, runtime = open_runtime(options.runtime, network.model, options.threads)
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
    """The time of all tiles on a board's DPU, by the cost model, in whole batches and with one
    exposure each.

    The host takes the consistency step where the network gives a pixel for each pixel.
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
        return unavailable("s", f"the cost model takes {error.expected}, got {error.got}")
    return swath_latency(prediction, math.ceil(plan.tiles / prediction.batch))
