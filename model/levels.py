"""The levels of an interval. It imports nothing heavy, so that '--help' stays quick."""

from typing import Literal, get_args

Level = Literal[50, 68, 80, 90, 95, 99]
"""The share of pixels whose error lies within the half-width, in percent."""

LEVELS: tuple[Level, ...] = get_args(Level)

INTERVAL = "interval"
"""The key of a calibrated interval in the metadata of an ONNX file and the header of weights."""
