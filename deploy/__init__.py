"""The machine: ONNX export, tiling, the DPU's operator checker and cost model, reports, the command line."""

import quant  # noqa: F401  # silences the runtimes before a module here loads one

__version__ = "0.1.0"
