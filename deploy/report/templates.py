"""The templates of this folder: every value that they show is escaped."""

import base64
import hashlib
import re
from functools import cache
from pathlib import Path

import jinja2

from deploy.report.marks import Polygon

INTERVAL = re.compile(r"\[[^\[\]]*\]")


@cache
def templates() -> jinja2.Environment:
    """The environment, with the filters `corners`, `digest` and `unbroken`."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    made = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    made.filters |= {"corners": corners, "digest": digest, "unbroken": unbroken}
    return made


def corners(polygon: Polygon) -> str:
    """A polygon as SVG writes it."""
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in polygon)


def unbroken(text: str) -> str:
    """The text with each interval in brackets on one line."""
    return INTERVAL.sub(lambda found: found[0].replace(" ", "\N{NO-BREAK SPACE}"), text)


def digest(text: str) -> str:
    """What a content security policy names a script or a style sheet by."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
