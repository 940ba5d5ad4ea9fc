"""Parse JSON from files that a user names, more strictly than Python does."""

import json
import math
from collections import Counter
from pathlib import Path

from beers_deploy.profiles.user_files.whole import QUOTED, TOO_DEEP, read_whole

JSON_BYTES = 1 << 26
"""The maximum size of a file."""


def read_json(path: Path) -> object:
    """Read a JSON file as plain values of Python.

    Raises:
        ValueError: the file is too large or no valid JSON; the message is the reason.
        OSError: the file cannot be opened.
    """
    return parse_json(read_whole(path, JSON_BYTES).decode("utf-8-sig"))


def parse_json(text: str) -> object:
    """Parse JSON text from an untrusted source into plain values of Python.

    Raises:
        ValueError: the text is empty or no valid JSON, has a key twice, or a number that float64
            cannot hold; the message is the reason.
    """
    if not text.strip():
        raise ValueError("it is an empty file")
    try:
        document: object = json.loads(
            text,
            parse_constant=_number,
            parse_float=_number,
            parse_int=_whole,
            object_pairs_hook=_unique,
        )
        # Half a surrogate pair cannot be printed.
        json.dumps(document, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    return document


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return an object; raise ValueError if it has a key twice, because readers disagree about its
    value.
    """
    members = dict(pairs)
    if len(members) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"it has the key {twice[:QUOTED]!r} twice")
    return members


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:20]} is not finite")
    return value


def _whole(text: str) -> int:
    # It refuses numbers that float64 cannot represent.
    _number(text)
    return int(text)
