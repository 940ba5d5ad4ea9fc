"""Find and read a profile: a shipped name, or the path of the user's own TOML file."""

import json
import math
import re
import stat
import tomllib
from collections import Counter
from contextlib import suppress
from pathlib import Path

from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.shipped import profile_path, shipped_names

TOML_BYTES = 1 << 16
"""The maximum size of a file, five times the largest shipped profile."""
JSON_BYTES = 1 << 26
TOO_DEEP = "too many levels of nesting"
LFS_POINTER = b"version https://git-lfs"
QUOTED = 80
"""The maximum number of characters that a message shows of a line with an error."""


def read_toml_text(path: Path) -> dict[str, object]:
    """Read a TOML file as plain values of Python.

    The values may include inf, nan and integers of any size.

    Raises:
        ValueError: the file is too large or no valid TOML; the message is the reason, with the
            line.
        OSError: the file cannot be opened.
    """
    # Some editors on Windows begin a file with a byte order mark.
    text = read_whole(path, TOML_BYTES).decode("utf-8-sig")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        # tomllib's message ends in "(at line 3, column 9)" or "(at end ...)".
        reason, _, where = str(error).rpartition(" (at ")
        lines = text.rstrip().split("\n")
        place = re.match(r"line (\d+)", where)
        number = int(place[1]) if place else len(lines)
        line = lines[number - 1].strip() if number <= len(lines) else ""
        raise ValueError(f"line {number}, {line[:QUOTED]!r}: {reason}") from None
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    # Python converts no more than 4300 digits, and its message names a setting of its own.
    except ValueError:
        raise ValueError("a number has too many digits") from None


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


def read_whole(path: Path, limit_bytes: int) -> bytes:
    """Read all bytes of a file that is not larger than expected.

    Raises:
        ValueError: the path is no regular file, a Git LFS pointer, or larger than `limit_bytes`.
        OSError: the file does not exist or cannot be opened.
    """
    status = path.stat()
    if reason := unreadable(path):
        raise ValueError(reason)
    if status.st_size > limit_bytes:
        raise ValueError(f"it has more than {limit_bytes} bytes")
    return path.read_bytes()


def unreadable(path: Path) -> str | None:
    """Return the reason why a path cannot be read as a file, as a phrase for a message, or None if
    it can be read.

    Git LFS stores a pointer in place of each large file that was not fetched: 130 bytes of text
    under the name of the file.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return "no such file"
    # One reason is a name that is too long.
    except OSError as error:
        return error.strerror or str(error)
    if not stat.S_ISREG(mode):
        return "it is a folder" if stat.S_ISDIR(mode) else "it is not a regular file"
    with suppress(OSError), path.open("rb") as stream:
        if stream.read(len(LFS_POINTER)) == LFS_POINTER:
            return "it is a Git LFS pointer to the file, which 'git lfs pull' fetches"
    return None


def read_toml(kind: str, name: str) -> tuple[str, dict[str, object]]:
    """Read the TOML file of a profile.

    Args:
        kind: the folder of shipped profiles: "sensors", "scenes" or "targets".
        name: the name of a shipped profile, or the path of the user's own .toml file.

    Returns:
        The file's name, as a label for messages, and its content.

    Raises:
        ProfileError: no such profile, or a file that cannot be read as TOML.
    """
    path = profile_path(kind, name)
    names = shipped_names(kind)
    if not name.endswith(".toml") and name not in names:
        raise ProfileError(
            f"There is no profile {printable(repr(name))}. Give one of {', '.join(names)}, or the "
            "path of a .toml file; 'beers-deploy profiles' shows them all."
        )
    try:
        return path.name, read_toml_text(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ProfileError(
            f"{printable(str(path))} cannot be read: {reason}. Check the path."
        ) from error
    except ValueError as error:
        raise ProfileError(
            f"{path} cannot be read as TOML: {printable(str(error))}. Correct it."
        ) from error
