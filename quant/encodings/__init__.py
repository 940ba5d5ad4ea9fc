"""Encode the integer core as ONNX in three encodings of the same numbers, and read it back.

The host's file runs on stock onnxruntime by integer kernels, from image to restored image. The
board's file is the core alone as QDQ ONNX, with int8 bias and power-of-two scales. VINT8 is the
same in the layout that AMD's NPU flow accepts. Reading a host file back returns the numbers for
analysis.
"""

from beers_deploy.quant.encodings.board import (
    CONFIG,
    OF_NPU,
    as_on_board,
    board_model,
    required_tile,
    save_config,
    vint8_model,
)
from beers_deploy.quant.encodings.checksum import (
    CHECKSUM,
    require_undamaged,
    with_damage_of,
)
from beers_deploy.quant.encodings.description import BORDER_PX, PLACE_PX, SENSOR_BIASES
from beers_deploy.quant.encodings.description import KEY as CORE
from beers_deploy.quant.encodings.explicit import implicit_parts
from beers_deploy.quant.encodings.host import encoding_faults, host_model, read_core

__all__ = [
    "BORDER_PX",
    "CHECKSUM",
    "CONFIG",
    "CORE",
    "OF_NPU",
    "PLACE_PX",
    "SENSOR_BIASES",
    "as_on_board",
    "board_model",
    "encoding_faults",
    "host_model",
    "implicit_parts",
    "read_core",
    "require_undamaged",
    "required_tile",
    "save_config",
    "vint8_model",
    "with_damage_of",
]
