"""The host's part of an INT8 network: the computations on the processor around the integer core.

- `part`: `HostPart`, which moves pixels, encodes the image, decodes the core's result and adds the
  image;
- `input_encoding`: encodes an image as the int8 planes that the core reads;
- `output_decoding`: combines the copies that the core writes of each channel to one value;
- `description`: the host's part as JSON, in the metadata of an INT8 file;
- `writer`: writes the ONNX nodes of the host.

Encodings and decodings have three forms each: NumPy, ONNX nodes, and constants for a kit's
`host.py`.
"""

from beers_deploy.quant.host_part.description import host_part_from_json, host_part_to_json
from beers_deploy.quant.host_part.input_encoding import (
    BANK_SLICES,
    IMAGE_SLICES,
    Direct,
    InputEncoding,
)
from beers_deploy.quant.host_part.output_decoding import (
    ANALYTIC_COPIES,
    FINE_MAX,
    GAIN,
    BankSum,
    DualRange,
    OffsetWindows,
    OutputDecoding,
    Plain,
)
from beers_deploy.quant.host_part.part import ONE_CHANNEL, HostPart
from beers_deploy.quant.host_part.writer import ZERO, HostWriter

__all__ = [
    "ANALYTIC_COPIES",
    "BANK_SLICES",
    "FINE_MAX",
    "GAIN",
    "IMAGE_SLICES",
    "ONE_CHANNEL",
    "ZERO",
    "BankSum",
    "Direct",
    "DualRange",
    "HostPart",
    "HostWriter",
    "InputEncoding",
    "OffsetWindows",
    "OutputDecoding",
    "Plain",
    "host_part_from_json",
    "host_part_to_json",
]
