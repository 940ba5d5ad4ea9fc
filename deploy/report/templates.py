"""The templates of this folder: every value that they show is escaped."""

import base64
import hashlib
from functools import cache
from pathlib import Path

import jinja2

from deploy.report.marks import Polygon


@cache
def templates() -> jinja2.Environment:
    """The environment, with the filters `corners` and `digest`."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters |= {"corners": corners, "digest": digest}
    return made


def corners(polygon: Polygon) -> str:
    """A polygon as SVG writes it."""
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in polygon)


def digest(text: str) -> str:
    """What a content security policy names a script or a style sheet by."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
