"""Find and read a profile: a shipped name, or the path of the user's own TOML file."""

import re
import tomllib
from pathlib import Path

from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.shipped import profile_path, shipped_names
from beers_deploy.profiles.user_files.whole import QUOTED, TOO_DEEP, read_whole

TOML_BYTES = 1 << 16
"""The maximum size of a file, five times the largest shipped profile."""


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
