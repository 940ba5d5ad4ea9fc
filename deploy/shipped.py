"""The shipped networks' files, found without loading anything."""

from pathlib import Path

from model.shipped import SHIPPED, shipped_weights

VARIANT = "convbeers-s"

SENSOR = "pleiades-degraded"
"""The sensor profile of a command that is told none: the same for all, so that a network is judged where it was
calibrated. (`train` alone defaults to a range of sensors.)"""


def default_float_weights() -> Path:
    """The shipped float weights (safetensors)."""
    return shipped_weights(VARIANT)


def default_int8() -> Path:
    """The shipped INT8 network (ONNX, host spelling)."""
    return shipped_pair(VARIANT)[1]


def shipped_pair(variant: str) -> tuple[Path, Path]:
    """The float weights of that name and their INT8 network (ONNX, host spelling).

    Raises:
        ModelError: none are shipped.
    """
    return shipped_weights(variant), SHIPPED / f"{variant}-int8.onnx"
