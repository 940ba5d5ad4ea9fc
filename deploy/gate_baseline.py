"""What an earlier gate found, to hold a later one against."""

from pathlib import Path
from typing import Any

from profiles.errors import OptionError
from profiles.text import read_json

PATCHES = ("sensor", "images", "patches", "seed")
"""The arguments that say what INT8 and float are compared on."""


def baseline_mae(path: Path, arguments: dict[str, Any]) -> float:
    """The MAE in a document that an earlier `gate --json` wrote, of the same patches.

    Args:
        path: the document.
        arguments: of this run of the gate.

    Raises:
        OptionError: no such document, or one of other patches.
    """
    try:
        document: Any = read_json(path)
        before = {name: _plain(name, document["arguments"][name]) for name in PATCHES}
        mae = float(next(row["figures"]["MAE"]["value"] for row in document["rows"] if row["table"] == "gate"))
    except (OSError, ValueError, KeyError, TypeError, StopIteration) as error:
        got = "no such file" if not path.exists() else "another document"
        remedy = "give what 'gate --json' wrote"
        raise OptionError(str(path), expected="a gate's results", got=got, remedy=remedy) from error
    for name in PATCHES:
        now = _plain(name, arguments[name])
        if before[name] != now:
            expected, got = f"a baseline of the same patches ({name} {now})", f"{name} {before[name]}"
            raise OptionError(str(path), expected=expected, got=got, remedy="make it anew with these")
    return mae


def _plain(name: str, value: object) -> str:
    """As text; of a folder of images its name, for it may lie elsewhere."""
    return Path(str(value)).name if name == "images" else str(value)
