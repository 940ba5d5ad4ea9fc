"""Write docs/reference/api.md: `python docs/make/api.py`.

What `beers_deploy` offers, in the order of use, for mkdocstrings to fill.

A test keeps it fresh: it names every object that the package's `__all__` has.
"""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import beers_deploy as bd

TARGET = Path(__file__).parents[1] / "reference" / "api.md"
OPENING = """# Python

The names of `import beers_deploy as bd`, with their docstrings ([how to use them](../how-to/notebook.md)). The
examples also use `import numpy as np`. Other modules may change without notice ([what is promised](promises.md)).
"""
GROUPS = {
    "Image and sensor": ("Sensor", "sensors", "characterize", "simulate"),
    "Restore and evaluate": ("restore", "evaluate", "demo"),
    "Network, INT8 and gate": (
        "Network",
        "networks",
        "check",
        "quantize",
        "gate",
        "Limits",
        "compare",
        "stress",
        "export",
    ),
    "Board": ("Board", "boards", "bench", "tradeoff", "golden"),
    "Training": ("train",),
    "Results and errors": ("Table", "Pair", "BeersError"),
}
"""The names that the package offers, by what they are used for."""


def document() -> str:
    """Return the page: a directive for each name, under the heading of its group.

    Raises:
        ValueError: a name that the package has and no group, or the other way round.
    """
    offered = {*vars(bd)["__all__"]}
    grouped = {*chain.from_iterable(GROUPS.values())}
    if offered != grouped:
        raise ValueError(f"put into `GROUPS`, or take out of it: {sorted(offered ^ grouped)}")
    return "\n".join([OPENING, *_sections()])


def _sections() -> Iterator[str]:
    for title, names in GROUPS.items():
        yield f"## {title}\n"
        yield from (f"::: beers_deploy.{name}\n" for name in names)


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8", newline="\n")
    print(f"wrote {TARGET}")
