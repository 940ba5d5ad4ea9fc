"""Where the shipped weights lie; nothing is loaded to find them."""

from pathlib import Path

from profiles.errors import ModelError

SHIPPED = Path(__file__).parent / "weights"


TOLD_SUFFIX = "-told"
"""Of the names of weights that need a sensor before they are a network."""


def shipped_names() -> list[str]:
    """The names of the shipped networks' float weights: a variant, or a variant fine-tuned for a sensor."""
    return [name for name in _names() if not name.endswith(TOLD_SUFFIX)]


def told_names() -> list[str]:
    """The names of the shipped weights that are told their sensor: each a network for every sensor in range."""
    return [name for name in _names() if name.endswith(TOLD_SUFFIX)]


def _names() -> list[str]:
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def shipped_weights(name: str) -> Path:
    """The shipped weights of that name.

    Raises:
        ModelError: none are shipped.
    """
    if name not in _names():
        remedy = "train them with 'beers-deploy train' and pass --checkpoint"
        expected = f"shipped weights ({', '.join(_names())})"
        raise ModelError(f"weights {name}", expected=expected, got="none", remedy=remedy)
    return SHIPPED / f"{name}.safetensors"


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
    """The shipped INT8 network (ONNX, host encoding)."""
    return shipped_pair(VARIANT)[1]


def shipped_pair(variant: str) -> tuple[Path, Path]:
    """The float weights of that name and their INT8 network (ONNX, host encoding).

    Raises:
        ModelError: none are shipped.
    """
    return shipped_weights(variant), SHIPPED / f"{variant}-int8.onnx"
