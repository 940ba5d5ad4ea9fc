"""Static INT8 in one call: float ONNX and calibration patches in, the two spellings of the integer core out."""

from collections.abc import Callable
from dataclasses import dataclass

import onnx

from quant.board_file import board_model
from quant.calibration import Patches, choose_positions
from quant.core import IntCore, build_core, shift_faults
from quant.graph import correction_graph, relu_count
from quant.host_file import host_model
from quant.onnx_file import fixed_tile_px, metadata
from quant.planes import read_planes

PASSES = 2
"""Times that every calibration patch is looked at."""


@dataclass(frozen=True)
class Quantised:
    """One network in whole numbers, for the host and for the board."""

    host: onnx.ModelProto
    board: onnx.ModelProto
    core: IntCore
    relus: int


def quantise_model(
    model: onnx.ModelProto, patches: Patches, about: dict[str, str], tick: Callable[[], None]
) -> Quantised:
    """Quantise a float ConvBEERS under the DPU's rules: int8, symmetric, per tensor, power-of-two positions.

    1. The global add stays on the host, in 12 bits: only the correction is computed in int8.
    2. The image enters as two int8 planes, so that all 12 bits are seen.
    3. Positions have the least squared error over the calibration patches.

    Raises:
        ModelError: not a graph of convolutions, ReLUs and adds that ends with the global add.
    """
    graph = read_planes(correction_graph(model))
    positions = choose_positions(graph, (degraded for degraded, _ in patches.pairs), tick)
    core = build_core(graph, positions)
    faults = shift_faults(core)
    assert not faults, faults  # noqa: S101 - build_core has moved every position within reach
    about = {**metadata(model), "precision": "int8 legal", "calibration_sha256": patches.digest, **about}
    tile_px = fixed_tile_px(model)
    return Quantised(host_model(core, about, tile_px), board_model(core, about, tile_px), core, relu_count(graph))
