"""Where the shipped weights lie; nothing is loaded to find them."""

from pathlib import Path

from beers_deploy.profiles.errors import ModelError

SHIPPED = Path(__file__).parent / "weights"

VARIANT = "convbeers-s"

INT8 = "-int8"
"""Behind a network's name: that network in INT8."""

SENSOR = "pleiades-degraded"
"""The sensor profile of a command that names none: the same for all.

(`train` alone defaults to a range of sensors, and `restore` to a sensor that is not known.)
"""


def shipped_names() -> list[str]:
    """The names of the shipped networks: each the weights of one network for
    every sensor in range.
    """
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def shipped_weights(name: str) -> Path:
    """The shipped weights of that name."""
    if name not in shipped_names():
        raise ModelError(
            f"There are no shipped weights {name!r}, only {', '.join(shipped_names())}. Give one "
            "of these, or the file that 'beers-deploy train' wrote."
        )
    return SHIPPED / f"{name}.safetensors"
