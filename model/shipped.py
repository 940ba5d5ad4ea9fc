"""Locate the shipped weights without loading anything."""

from pathlib import Path

from beers_deploy.profiles.errors import ModelError

SHIPPED = Path(__file__).parent / "weights"

VARIANT = "convbeers-s"

INT8 = "-int8"
"""The suffix of a network's name that denotes the network in INT8."""

SENSOR = "pleiades-degraded"
"""The default sensor profile of all commands.

(Only `train` defaults to a range of sensors, and `restore` to an unknown sensor.)
"""


def shipped_names() -> list[str]:
    """List the names of the shipped networks; each is one network for every sensor in range."""
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def shipped_weights(name: str) -> Path:
    """Return the path of the shipped weights of that name, or raise ModelError if
    there are none.
    """
    if name not in shipped_names():
        raise ModelError(
            f"There are no shipped weights {name!r}, only {', '.join(shipped_names())}. Give one "
            "of these, or the file that 'beers-deploy train' wrote."
        )
    return SHIPPED / f"{name}.safetensors"
