"""The whole chain on one image, step by step, ending with a report: what `beers-deploy demo` does.

image -> export -> gate -> check -> traditional and INT8 restoration -> predicted bench -> report
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch

from deploy.bench.host import Sensors, traditional_rows
from deploy.bench.tables import Swath, predict_file, predicted_rows, published_rows, sweep_rows, within_words
from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.checker.placement import Placement, place
from deploy.dpu.reading import read_network
from deploy.export import require_parity, torch_network
from deploy.methods import network_method
from deploy.networks import Conditioned, Say, warn_outside
from deploy.report.page import Picture, Report, Table
from deploy.restoration.options import TILE_PX
from model.evaluation.methods import Restore
from model.evaluation.scores import fidelity_row
from model.io.files import whole_file
from model.io.images import read_acquisition, read_pixels
from model.io.pictures import busiest_windows, picture_url, stretch_of, strip
from model.io.tiff import write_tiff
from model.shipped import SENSOR, VARIANT, shipped_weights
from model.simulator.acquire import MARGIN_PX, Pair, simulate_pair
from model.simulator.detector import Draw
from model.simulator.procedural import load_scenes, procedural_scene
from model.simulator.sampling import Scene, read_scene
from model.traditional.pipeline import Chain, restore_traditional
from profiles import load_sensor
from profiles.errors import OptionError
from profiles.figures import Row, measured
from profiles.sensor_file import reference_for
from profiles.target import DEFAULT_TARGET, board_names
from quant.calibration import HELD_OUT_SEED, draw_patches
from quant.encodings import board_model, read_core
from quant.gate import compare, gate_row
from quant.onnx_file import metadata, save_onnx
from quant.session import open_session
from quant.tiling.walk import receptive_radius_px

CROP_PX, ZOOM = 110, 3
LARGEST_PX = 1280
SWATH_PX = (13600, 9016)
"""Width and height of the paper's swath."""

TRADITIONAL, INT8 = "traditional", f"{VARIANT}, INT8"


@dataclass(frozen=True)
class Boards:
    """A row a board, and which of them takes WITHIN_S or less."""

    rows: list[Row]
    words: str


def demo_report(
    shape: tuple[int, ...],
    pictures: list[Picture],
    bench: list[Row],
    swath: list[Row],
    boards: Boards,
    quality: list[Row],
    gate: tuple[Row, ...],
    placement: Placement,
) -> Report:
    """The page for an image of that shape (H, W): pictures first, then time, quality and the gate."""
    tables = [
        Table(f"Time and power for this image, {shape[1]} x {shape[0]}", bench),
        Table(f"A swath of {SWATH_PX[0]} x {SWATH_PX[1]}, beside the paper's figures", swath, SWATH_CAPTION),
        Table("The same swath on each board, predicted", boards.rows, f"{BOARDS_CAPTION} {boards.words}."),
        *([Table("Quality on this image, over 4095 DN", quality)] if quality else []),
        Table("What quantisation changes", gate, GATE_CAPTION),
    ]
    return Report(
        "From training to board, on one image",
        headline(bench, quality, placement),
        tables,
        pictures,
        NOTES,
    )


SWATH_CAPTION = (
    "The traditional pipeline is measured on crops of this image and scaled; the paper's rows are what it printed "
    "for another network (16 blocks of 64 features) on its own hardware."
)
BOARDS_CAPTION = "The same INT8 file on each board's default configuration. Of these,"
WITHIN_S = 60.0
"""What a swath may take, for the smallest board to be named."""
GATE_CAPTION = (
    "On simulated patches that calibration did not see; the INT8 network obeys the DPU's power-of-two rules."
)
NOTES = (
    "Nothing here has run on a board: the DPU's figures come from a cost model fitted on published networks.",
    "The power of the DPU run is an assumption anchored at the paper's single figure, with a range.",
    "INT8 time on this CPU is no proxy for the DPU.",
)


def headline(bench: list[Row], quality: list[Row], placement: Placement) -> str:
    """One sentence: does it fit, how fast, at what quality."""
    latency = next(row for row in bench if "whole tiles" in row.name).figures["latency"]
    cpu = bench[0].figures["latency"]
    fits = (
        "fits the DPU whole"
        if placement.dpu_subgraphs == 1 and not placement.failed
        else "does not fit the DPU whole"
    )
    text = f"{VARIANT} in INT8 {fits}: predicted {latency} s for this image on a {DEFAULT_TARGET.upper()}"
    text += f", against {cpu} s {cpu.mode} for the traditional pipeline on this CPU"
    if quality:
        before, after = quality[0].figures["PSNR"], quality[-1].figures["PSNR"]
        text += f"; PSNR rises from {before} to {after} dB (measured)"
    return text + "."


def comparison(images: dict[str, np.ndarray], out: Path) -> list[Picture]:
    """Crops of several (H, W) images side by side, also written as before-after.png, and the INT8 result whole."""
    first = next(iter(images.values()))
    side = min(CROP_PX, *first.shape)
    stretch = stretch_of(first)
    windows = busiest_windows(first, side)
    crops = strip(images, windows, side, ZOOM, stretch)
    with whole_file(out / "before-after.png") as temporary:
        crops.save(temporary, "PNG", optimize=True)
    whole = stretch.to_bytes(images[INT8])[:LARGEST_PX, :LARGEST_PX]
    where = " and ".join(f"row {top}, column {left}" for top, left in windows)
    return [
        Picture(
            "The same crops, before and after",
            picture_url(np.asarray(crops)),
            f"{side} pixels a side from {where}, enlarged {ZOOM} times.",
        ),
        Picture(f"Restored by {INT8}", picture_url(whole), "The network's output, same grey scale as above."),
    ]


BITS = 12
"""Of a digital number, to the networks' files."""
SIDE_PX = 640
GATE_PATCHES = 12
FILES = ("report.html", "float.onnx", "int8.onnx", "core.onnx", "restored.tif", "before-after.png")
"""What a run leaves in its folder."""


@dataclass(frozen=True)
class Input:
    """The degraded image, (H, W) digital numbers, and the truth where it is known."""

    name: str
    degraded: np.ndarray
    pair: Pair | None


@dataclass(frozen=True)
class Demo:
    """What the demo found: the rows of every table, and the report."""

    rows: tuple[Row, ...]
    report: Report


def load_sensors(name: str = SENSOR) -> Sensors:
    """The sensor that the demo simulates, and the one it imitates.

    Raises:
        OptionError: a sensor of other than 12 bits.
        ProfileError: no such sensor.
    """
    degraded = load_sensor(name)
    if degraded.nominal().bits != BITS:
        got, remedy = f"{degraded.nominal().bits} bits", "use 'restore', with --full-scale or --method traditional"
        raise OptionError("--sensor", expected=f"a sensor of {BITS} bits", got=got, remedy=remedy)
    return Sensors(degraded, reference_for(degraded))


def read_input(image: Path | None, seed: int, sensors: Sensors, full_scale: float | None = None) -> Input:
    """A drawn scene, a photograph as a scene (8 bits), or a raw acquisition (mono, up to 12 bits).

    With the pixel value that is its `full_scale`, any image is a raw acquisition.
    """
    if image is None:
        side = (SIDE_PX + 2 * MARGIN_PX) * int(sensors.degraded.oversampling.low)
        return _simulated(procedural_scene(side, side, np.random.default_rng(seed)), seed, sensors)
    if full_scale is None and read_pixels(image).dtype == np.uint8:
        return _simulated(read_scene(image, sensors.reference.nominal()), seed, sensors)
    return Input(image.name, read_acquisition(image, full_scale, None), None)


def _simulated(scene: Scene, seed: int, sensors: Sensors) -> Input:
    ratio = int(sensors.degraded.oversampling.low)
    pair = simulate_pair(scene.radiance, sensors.degraded.nominal(), sensors.reference.nominal(), ratio, Draw(seed))
    return Input(scene.name, pair.degraded.numpy(), pair)


def run_demo(
    image: Path | None,
    out: Path,
    seed: int,
    say: Callable[[str], None],
    full_scale: float | None = None,
    sensor: str = SENSOR,
) -> Demo:
    """Run the chain, write its files into `out`, and return the figures and the report.

    Files: float.onnx, int8.onnx, core.onnx (the board's encoding), restored.tif, before-after.png.
    """
    say("reading the image")
    sensors = load_sensors(sensor)
    given = read_input(image, seed, sensors, full_scale)
    say("telling the shipped network the sensor, and gating its INT8")
    gate, int8, exact = tell_and_gate(out, seed, sensors, say)
    say("checking every operator against the DPU")
    dpu = load_dpu(DEFAULT_TARGET)
    placement = place(read_network(out / "int8.onnx", TILE_PX), dpu)
    say("restoring: traditional pipeline and INT8 network")
    methods = _methods(int8, sensors)
    restored = {name: method(given.degraded) for name, method in methods.items()}
    write_tiff(out / "restored.tif", restored[INT8].astype(np.uint16))
    images = {"degraded input": given.degraded, **restored}
    if given.pair is not None:
        images["reference"] = given.pair.reference.numpy()
    pictures = comparison(images, out)
    quality = _quality(given, restored)
    say("measuring the traditional pipeline, predicting the board")
    bench, swath = bench_rows(out / "int8.onnx", given.degraded, dpu, receptive_radius_px(int8), sensors)
    boards = on_boards(out / "int8.onnx", receptive_radius_px(int8))
    rows = (*bench, *swath, *boards.rows, *quality, gate, exact)
    shape, gates = given.degraded.shape, (gate, exact)
    return Demo(rows, demo_report(shape, pictures, bench, swath, boards, quality, gates, placement))


def tell_and_gate(out: Path, seed: int, sensors: Sensors, say: Say) -> tuple[Row, onnx.ModelProto, Row]:
    """Tell the shipped network the sensor, in float32 and in INT8; the gate's row and the INT8 model."""
    shipped = Conditioned(VARIANT, shipped_weights(VARIANT))
    warn_outside(sensors.degraded, say)
    floating, int8 = (shipped.model(sensors.degraded, int8) for int8 in (False, True))
    for name, model in (("float", floating), ("int8", int8), ("core", board_model(read_core(int8), metadata(int8)))):
        save_onnx(model, out / f"{name}.onnx")
    network = torch_network(shipped_weights(VARIANT), sensors.degraded.nominal())
    difference = require_parity(network, floating, 97)
    unseen = load_scenes(None, sensors.reference.nominal(), seed + HELD_OUT_SEED)
    held_out = draw_patches(unseen, sensors.degraded, sensors.reference, GATE_PATCHES, seed + HELD_OUT_SEED)
    verdict = compare(open_session(floating), open_session(int8), held_out.pairs)
    source = "one random image of 97 x 97"
    exact = Row("gate", "ONNX against torch", {"max": measured(difference, "of full scale", source)})
    return gate_row(verdict), int8, exact


def bench_rows(model: Path, dn: np.ndarray, dpu: Dpu, halo_px: int, sensors: Sensors) -> tuple[list[Row], list[Row]]:
    """Speed for this image, and for the swath of the paper with its published rows beside."""
    prediction = predict_file(model, dpu)
    tables = []
    for width, height in ((dn.shape[1], dn.shape[0]), SWATH_PX):
        swath = Swath(width, height, TILE_PX, halo_px)
        network = predicted_rows(VARIANT, prediction, swath, dpu)
        tables.append([*traditional_rows(dn, swath, sensors, [dpu.target])[0], *network])
    return tables[0], [
        *(_in_table(row, "swath") for row in tables[1]),
        *(_in_table(r, "swath") for r in published_rows()),
    ]


def on_boards(model: Path, halo_px: int) -> Boards:
    """The swath of the paper on the default configuration of each board."""
    dpus, swath = [load_dpu(name) for name in board_names()], Swath(*SWATH_PX, TILE_PX, halo_px)
    rows = sweep_rows(model, swath, dpus, [TILE_PX])
    return Boards([_in_table(row, "boards") for row in rows], within_words(rows, dpus, WITHIN_S))


def _in_table(row: Row, table: str) -> Row:
    return Row(table, row.name, row.figures, row.text)


def _methods(int8: onnx.ModelProto, sensors: Sensors) -> dict[str, Restore]:
    plain = sensors.degraded.nominal(), sensors.reference.nominal()
    return {
        TRADITIONAL: lambda dn: restore_traditional(torch.from_numpy(dn), Chain(*plain)).numpy(),
        INT8: network_method(int8, sensors.degraded.nominal().max_dn),
    }


def _quality(given: Input, restored: dict[str, np.ndarray]) -> list[Row]:
    if given.pair is None:
        return []
    reference = given.pair.reference.numpy()
    images = {"degraded input": given.degraded, **restored}
    return [fidelity_row("quality", name, dn, reference, given.degraded) for name, dn in images.items()]
