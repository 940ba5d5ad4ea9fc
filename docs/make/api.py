"""Write docs/reference/api.md: `python docs/make/api.py`.

What `beers_deploy` offers, for mkdocstrings to fill.

A test keeps it fresh: it names every object that the package's `__all__` has.
"""

from pathlib import Path

import beers_deploy as bd

TARGET = Path(__file__).parents[1] / "reference" / "api.md"
OPENING = """# Python

The names of `import beers_deploy as bd`, with their docstrings ([how to use them](../how-to/notebook.md)). The
examples also use `import numpy as np`. Other modules may change without notice ([what is promised](promises.md)).
"""


def document() -> str:
    """Return the page: a directive for each name, at the module that defines it."""
    names = sorted(vars(bd)["__all__"], key=str.lower)
    return "\n".join([OPENING, *(f"::: {getattr(bd, name).__module__}.{name}\n" for name in names)])


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8", newline="\n")
    print(f"wrote {TARGET}")
