"""The integer core as ONNX, in three encodings of the same numbers, and read back.

The host's file runs on stock onnxruntime by integer kernels, from image to restored image; the
board's is the core by itself as QDQ ONNX, with int8 bias and power-of-two scales; VINT8 is that in
the layout that AMD's NPU flow takes. Reading a host file back gives numbers to reason about.
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
from beers_deploy.quant.encodings.description import BORDER_PX, PLACE_PX
from beers_deploy.quant.encodings.description import KEY as CORE
from beers_deploy.quant.encodings.explicit import implicit_parts
from beers_deploy.quant.encodings.host import encoding_faults, host_model, read_core

__all__ = [
    "BORDER_PX",
    "CONFIG",
    "CORE",
    "OF_NPU",
    "PLACE_PX",
    "as_on_board",
    "board_model",
    "encoding_faults",
    "host_model",
    "implicit_parts",
    "read_core",
    "required_tile",
    "save_config",
    "vint8_model",
]
