"""The parts of the demonstration: input, tables of time, quality, pictures, headline."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import Placement
from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.pictures import busiest_windows, picture_url, stretch_of, strip
from beers_deploy.model.metrics.fidelity import fidelity_db, ssim
from beers_deploy.model.raster.images import read_acquisition, read_pixels
from beers_deploy.model.shipped import VARIANT
from beers_deploy.model.simulator.acquire import Pair, scene_side_px, simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import read_scene
from beers_deploy.network import Network
from beers_deploy.performance import board as bench_board
from beers_deploy.performance import tables
from beers_deploy.performance.swath import Swath, predict_network
from beers_deploy.performance.traditional import measure_pipeline
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Row, measured
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.profiles.shipped import DEFAULT_TARGET, TILE_PX, board_names
from beers_deploy.report.page import Picture, Section

BITS = 12
SIDE_PX = 640
CROP_PX = 110
ZOOM = 3
LARGEST_PX = 1280
SWATH_PX = (13600, 9016)
"""Width and height of the paper's swath."""
WITHIN_S = 60.0
"""The time limit for a swath, for which the smallest sufficient board is named."""
INPUT = "degraded input"
TRADITIONAL = "traditional"
INT8 = f"{VARIANT}, INT8"
REFERENCE = "reference"

SWATH_CAPTION = (
    "The traditional pipeline is measured on crops of this image and scaled; the paper's rows are "
    "what it printed for another network (16 blocks of 64 features) on its own hardware."
)
GATE_CAPTION = (
    "On simulated patches that calibration did not see; the INT8 network obeys the "
    "DPU's power-of-two rules."
)
DETAILS = bench_board.DETAILS | {"samples"}
"""Figures and tables that are shown only in detail."""

NOTES = (
    (
        "Nothing here has run on a board: the DPU's figures come from a cost model fitted on "
        "published networks."
    ),
    (
        "The power of the DPU run is an assumption anchored at the paper's single figure, with a "
        "range."
    ),
    "INT8 time on this CPU is no proxy for the DPU.",
)


def quality_rows(images: Mapping[str, np.ndarray], pair: Pair, degraded: np.ndarray) -> list[Row]:
    """Compute PSNR and SSIM of restored images against the reference of a simulated pair.

    Args:
        images: digital numbers (H, W) of each image, by the name of its row.
        pair: the simulated pair, whose reference is the truth.
        degraded: digital numbers (H, W) of the degraded image. Where it clips, no pixel counts in
            PSNR.

    Returns:
        A row of the table 'quality' for each image.
    """
    rows = []
    for name, dn in images.items():
        psnr = measured(fidelity_db(dn, pair.reference, degraded), "dB", "simulated pair")
        similarity = measured(ssim(dn, pair.reference, MAX_DN), "ratio", "simulated pair")
        rows.append(Row("quality", name, {"PSNR": psnr, "SSIM": similarity}))
    return rows


def load_sensors(sensor: SensorLike) -> tuple[Sensor, Sensor]:
    """Load the sensor that the demonstration simulates, and the reference sensor it restores to.

    Args:
        sensor: the sensor: a `Sensor`, a name or a .toml file.

    Returns:
        The sensor and its reference.

    Raises:
        OptionError: the sensor does not have 12 bits.
    """
    degraded = Sensor.load(sensor)
    if degraded.nominal().bits != BITS:
        raise OptionError(
            f"`sensor` must have {BITS} bits, but {degraded.name} has {degraded.nominal().bits}. "
            "Use 'restore', with a full scale or the traditional method."
        )
    return degraded, degraded.reference


def read_input(
    image: Path | None, seed: int, sensors: tuple[Sensor, Sensor], full_scale: float | None = None
) -> tuple[np.ndarray, Pair | None]:
    """Read or simulate the degraded image that the demonstration restores.

    Args:
        image: the file of a photograph (8 bits), which is the scene that the sensors acquire, or of
            a raw image of one band (up to 12 bits); None draws a synthetic scene.
        seed: the seed of every random draw.
        sensors: the sensor that acquires the scene, and the reference sensor.
        full_scale: the pixel value that is full scale. With it any image is taken as a raw image;
            None takes a file of 8 bits as a photograph.

    Returns:
        The degraded image (H, W) in digital numbers, and the pair of degraded and reference image
        if they were simulated, else None.

    Raises:
        ImageError: the image cannot be read, or its full scale is ambiguous.
    """
    degraded, reference = (profile.nominal() for profile in sensors)
    ratio = int(sensors[0].oversampling.low)
    if image is None:
        side = scene_side_px(SIDE_PX, ratio)
        scene = procedural_scene(side, side, np.random.default_rng(seed))
    elif full_scale is None and read_pixels(image).dtype == np.uint8:
        scene = read_scene(image, reference)
    else:
        return read_acquisition(image, full_scale, None), None
    pair = simulate_pair(scene.radiance, degraded, reference, ratio, Draw(seed))
    return pair.degraded, pair


def bench_tables(model: Network, dn: np.ndarray, sensors: tuple[Sensor, Sensor]) -> list[Section]:
    """Predict and measure the time and power of a restoration, in three tables.

    The tables are on this image, on a swath of the size that the paper restores (with the paper's
    published rows), and on this swath with each board's DPU.

    Args:
        model: the INT8 network.
        dn: digital numbers (H, W) of this image, on which the traditional pipeline is timed.
        sensors: the sensor of the image and the reference sensor, for the traditional pipeline.
    """
    dpu = load_dpu(DEFAULT_TARGET)
    halo_px = model.tiling.halo_px
    pipeline = measure_pipeline(dn, *sensors)
    rows = []
    for width, height in ((dn.shape[1], dn.shape[0]), SWATH_PX):
        swath = Swath(width, height, TILE_PX, halo_px, consistency=True)
        prediction = predict_network(model, dpu, step_px=swath.step_px)
        network = tables.predicted_rows(VARIANT, prediction, swath)
        rows.append([pipeline.row(swath), tables.processor_row(swath, dpu.target), *network])
    dpus = [load_dpu(name) for name in board_names()]
    boards = tables.sweep_rows(model, [swath], dpus)
    within = tables.within_words(boards, dpus, WITHIN_S)
    words = f"The same INT8 file on each board's default configuration. Of these, {within}."
    title = "A swath of {} x {}, next to the paper's figures".format(*SWATH_PX)
    return [
        Section(f"Time and power for this image, {dn.shape[1]} x {dn.shape[0]}", rows[0]),
        Section(
            title,
            [replace(row, table="swath") for row in (*rows[1], *tables.published_rows())],
            SWATH_CAPTION,
        ),
        Section(
            "The same swath on each board, predicted",
            [replace(row, table="boards") for row in boards],
            words,
        ),
    ]


def pictures_of(images: dict[str, np.ndarray], out: Path) -> list[Picture]:
    """Draw crops of the compared images side by side, and the image that the INT8 network restored.

    The crops are also written to before-after.png.

    Args:
        images: digital numbers (H, W) of each image, by its name; `INPUT` and `INT8` are among
            them.
        out: the folder of before-after.png.
    """
    side = min(CROP_PX, *images[INPUT].shape)
    stretch = stretch_of(images[INPUT])
    windows = busiest_windows(images[INPUT], side)
    crops = strip(images, windows, side, ZOOM, stretch)
    with whole_file(out / "before-after.png") as temporary:
        crops.save(temporary, "PNG", optimize=True)
    where = " and ".join(f"row {top}, column {left}" for top, left in windows)
    caption = f"{side} pixels a side from {where}, enlarged {ZOOM} times."
    restored_url = picture_url(stretch.to_bytes(images[INT8])[:LARGEST_PX, :LARGEST_PX])
    return [
        Picture("The same crops, before and after", picture_url(np.asarray(crops)), caption),
        Picture(
            f"Restored by {INT8}", restored_url, "The network's output, same grey scale as above."
        ),
    ]


def headline(bench: Sequence[Row], quality: Sequence[Row], placement: Placement) -> str:
    """Return the sentence at the top of the page: if the network fits the DPU, its predicted time
    compared with the traditional pipeline's, and its PSNR.

    Args:
        bench: the table on the time for this image; its first row is the traditional pipeline.
        quality: the table on quality, from the degraded input to the INT8 network; empty if there
            is no reference.
        placement: the parts of the network that the DPU runs.
    """
    latency = next(row for row in bench if "whole tiles" in row.name).figures["latency"]
    cpu = bench[0].figures["latency"]
    board = DEFAULT_TARGET.upper()
    fits = "fits" if placement.dpu_subgraphs == 1 and not placement.failed else "does not fit"
    text = (
        f"{VARIANT} in INT8 {fits} the DPU whole: predicted {latency} s for this image on a {board}"
    )
    text += f", against {cpu} s {cpu.mode} for the traditional pipeline on this CPU"
    if quality:
        before = quality[0].figures["PSNR"]
        after = quality[-1].figures["PSNR"]
        text += f"; PSNR rises from {before} to {after} dB (measured)"
    return f"{text}."
