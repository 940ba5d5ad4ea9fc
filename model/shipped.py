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
