"""Where the shipped weights lie; nothing is loaded to find them."""

from pathlib import Path

from profiles.errors import ModelError

SHIPPED = Path(__file__).parent / "weights"


def shipped_names() -> list[str]:
    """The names of the shipped float weights: a variant, or a variant fine-tuned for a sensor."""
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def shipped_weights(name: str) -> Path:
    """The shipped weights of that name.

    Raises:
        ModelError: none are shipped.
    """
    if name not in shipped_names():
        remedy = "train them with 'beers-deploy train' and pass --checkpoint"
        expected = f"shipped weights ({', '.join(shipped_names())})"
        raise ModelError(f"weights {name}", expected=expected, got="none", remedy=remedy)
    return SHIPPED / f"{name}.safetensors"
