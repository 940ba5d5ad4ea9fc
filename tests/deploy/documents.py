"""Functions that read documents as `--json` writes them."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jsonschema

from beers_deploy.results import SCHEMA_PATH


def valid(path: Path) -> dict[str, Any]:
    """Return the content of a document after checking it against the schema."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    jsonschema.validate(content, json.loads(SCHEMA_PATH.read_text(encoding="utf-8")))
    return content


def figures_of(rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield every figure of a document's rows, row by row."""
    for row in rows:
        yield from row["figures"].values()
