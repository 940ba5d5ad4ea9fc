"""The machine: ONNX export, tiling, the DPU's operator checker and cost model, reports, the command line."""

__version__ = "0.1.0"
