"""What shapes of ConvBEERS cost on boards, before anyone trains them: BLOCKSxFEATURES, at 1/SCALE
resolution @SCALE.

    python benchmarks/shapes.py [--shapes 4x16,8x32,4x64@2] [--boards vck190:C32B3,vck190:C32B6] \
        [--tile 640]

Random weights, quantised without a long search: predicted time does not depend on numbers. A swath
of 13600 x 9016 is cut into whole tiles with exact seams. What a shape is worth only training tells
(`beers-deploy train`, `evaluate`).
"""

import argparse
import math
import re
from itertools import chain
from unittest.mock import patch

import numpy as np
import onnx
import torch

from beers_deploy.dpu.board import Dpu, load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.latency import Prediction, predict
from beers_deploy.dpu.reading import network_of
from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.variants import Variant
from beers_deploy.performance.swath import PAPER_SIZE, Swath, parse_size, swath_latency
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.tiling.receptive_field import tiling_of

SHAPES = "4x16,8x32,16x64,2x32@2,8x32@2,4x48@2,4x64@2,2x64@4,4x128@4"
SHAPE = re.compile(r"(\d+)x(\d+)(?:@(\d+))?")
SIDE_PX = 48


def main() -> None:
    """Print a row a shape."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", default=SHAPES)
    parser.add_argument("--boards", default="vck190:C32B3", help="each with its configuration")
    parser.add_argument("--tile", type=int, default=640)
    arguments = parser.parse_args()
    boards = [load_dpu(*board.split(":")) for board in arguments.boards.split(",")]
    heads = list[str]()
    for dpu in boards:
        board = f"{dpu.target.name} {dpu.name}"
        heads += f"{board}, frame/s", f"{board}, s a swath"
    print("| shape | 1000 products a pixel | halo, px |", " | ".join(heads), "|")
    print("|---|---|---|" + "---|" * len(heads))
    for text in arguments.shapes.split(","):
        variant = parse_shape(text)
        model = int8(variant)
        products = sum(9 * a * b for a, b in variant.convolutions.values()) / variant.pixels
        cells = chain.from_iterable(cells_of(model, dpu, arguments.tile) for dpu in boards)
        print(
            f"| {text} | {products / 1e3:.0f} | {tiling_of(model).halo_px} |",
            " | ".join(cells),
            "|",
            flush=True,
        )


def parse_shape(text: str) -> Variant:
    """A shape as the command line names it."""
    match = SHAPE.fullmatch(text)
    if match is None:
        raise SystemExit(f"expected BLOCKSxFEATURES or BLOCKSxFEATURES@SCALE, got {text!r}")
    blocks, features, scale = match.groups(default="1")
    return Variant(int(blocks), int(features), int(scale))


def int8(variant: Variant) -> onnx.ModelProto:
    """An INT8 file of that shape."""
    network = ConvBEERS(variant)
    initialise(network, torch.Generator().manual_seed(0))
    image = np.random.default_rng(0).random((1, 1, SIDE_PX, SIDE_PX), dtype=np.float32)
    patches = Patches([(image, image)], [image])
    # The search does not try channels one by one.
    with patch("beers_deploy.quant.passes.equalize.MOST_CHANNELS", 0):
        return quantize_model(to_onnx(network.eval(), {}), patches, {}).host


def on_a_swath(
    model: onnx.ModelProto, dpu: Dpu, tile_px: int
) -> tuple[Prediction, float, float, float]:
    """The prediction of a tile; and seconds of the paper's swath in such tiles, with the ends of
    their interval.
    """
    prediction = predict(place(network_of(model, tile_px), dpu), dpu)
    swath = Swath(*parse_size(PAPER_SIZE), tile_px, tiling_of(model).halo_px)
    latency = swath_latency(prediction, math.ceil(swath.tiles / prediction.batch))
    return prediction, latency.value or math.nan, *(latency.interval or (math.nan, math.nan))


def cells_of(model: onnx.ModelProto, dpu: Dpu, tile_px: int) -> tuple[str, str]:
    """Frames a second and seconds a swath, each as its interval and the middle."""
    prediction, time_s, low_s, high_s = on_a_swath(model, dpu, tile_px)
    slow, fast = prediction.fps_interval
    star = " *" if prediction.outside else ""
    return (
        f"{slow:.3g} to {fast:.3g} ({prediction.fps:.3g}){star}",
        f"{low_s:.3g} to {high_s:.3g} ({time_s:.3g})",
    )


if __name__ == "__main__":
    main()
