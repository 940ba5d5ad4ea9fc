"""The shipped networks' files, found without loading anything."""

from pathlib import Path

from model.shipped import SHIPPED, shipped_names, shipped_weights, told_names

VARIANT = "convbeers-s"

SENSOR = "pleiades-degraded"
"""The sensor profile of a command that is told none: the same for all, so that a network is judged where it was
calibrated. (`train` alone defaults to a range of sensors.)"""


def default_float_weights() -> Path:
    """The shipped float weights (safetensors)."""
    return shipped_weights(VARIANT)


def float_file(given: Path) -> Path:
    """The file given, or the shipped float weights of that name where no such file lies."""
    return given if given.exists() or given.name not in _named(given) else shipped_weights(given.name)


def int8_file(given: Path | None) -> Path:
    """The file given, or the shipped INT8 network of that name where no such file lies; the default one if None."""
    if given is None:
        return default_int8()
    variant = given.name.removesuffix("-int8")
    return given if given.exists() or variant not in _named(given) else shipped_pair(variant)[1]


def _named(given: Path) -> list[str]:
    """Names that the text could be: none where it is a path of folders."""
    return [*shipped_names(), *told_names()] if given == Path(given.name) else []


def default_int8() -> Path:
    """The shipped INT8 network (ONNX, host spelling)."""
    return shipped_pair(VARIANT)[1]


def shipped_pair(variant: str) -> tuple[Path, Path]:
    """The float weights of that name and their INT8 network (ONNX, host spelling).

    Raises:
        ModelError: none are shipped.
    """
    return shipped_weights(variant), SHIPPED / f"{variant}-int8.onnx"
