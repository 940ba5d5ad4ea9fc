"""Read a results document that a command wrote with --json."""

import json
from pathlib import Path

from jsonschema import Draft202012Validator

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.toml import read_json
from beers_deploy.results import SCHEMA_PATH


def read_document(path: Path) -> dict[str, object]:
    """Read a results document; refuse what does not follow the schema."""
    try:
        document = read_json(path)
        schema = Draft202012Validator(json.loads(SCHEMA_PATH.read_text(encoding="utf-8")))
        error = next(schema.iter_errors(document), None)
        got = "" if error is None else f"another document: {error.message[:100]}"
    except FileNotFoundError:
        got = "no such file"
    except (OSError, ValueError) as error:
        got = " ".join(str(error).split())[:100]
    if got:
        remedy = "give what a command wrote with --json"
        raise OptionError(str(path), expected="a results document", got=got, remedy=remedy)
    return document  # type: ignore[return-value]
