"""Documents as `--json` writes them."""

import json
from pathlib import Path
from typing import Any

import jsonschema

from beers_deploy.results import SCHEMA_PATH


def valid(path: Path) -> dict[str, Any]:
    """What is in a document, once it keeps the schema."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    jsonschema.validate(content, json.loads(SCHEMA_PATH.read_text(encoding="utf-8")))
    return content
