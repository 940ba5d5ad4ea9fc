"""The manifest of a dataset: a line of JSON for each pair, with the digests of its two images and
of the line.

A dataset that is continued trusts no pair for being there: a pair counts if its line and both
images match.
"""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from beers_deploy.model.io.files import sha256
from beers_deploy.profiles.user_files.json_text import parse_json

Line = dict[str, object]
"""A line of the manifest, which describes one pair."""
ROLES = ("degraded", "reference")
DIGESTS = "sha256"


def image_of(out: Path, role: str, name: object) -> Path:
    """Return the path of one image of a pair in a dataset.

    Args:
        out: the dataset's folder.
        role: "degraded" or "reference", the subfolder.
        name: the name of the pair.
    """
    return out / role / f"{name}.tif"


def line_text(out: Path, line: Line) -> str:
    """Return the line that records a pair in the manifest, with the digests of its written images.

    Args:
        out: the dataset's folder.
        line: all else that the manifest states of the pair.
    """
    digests = {role: sha256(image_of(out, role, line["name"])) for role in ROLES}
    digests["line"] = _digest(line)
    return json.dumps(line | {DIGESTS: digests}, sort_keys=True) + "\n"


def matching_lines(out: Path, files: Iterable[Path]) -> dict[tuple[int, str], str]:
    """Return the lines of manifests whose images still have the recorded digests.

    The keys of the result are the number and the name of the pair.

    Args:
        out: the dataset's folder.
        files: paths of manifests, or of parts of one; missing files are skipped.
    """
    texts: dict[tuple[int, str], str] = {}
    for path in files:
        if not path.is_file():
            continue
        # A byte that is not valid UTF-8 spoils only its own line, whose digest then does not match.
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True):
            line = _matching(out, text)
            if line is not None:
                texts[line["number"], str(line["name"])] = text
    return texts


def _matching(out: Path, text: str) -> dict[str, Any] | None:
    """Return a line without its digests; None if the line or an image does not match them."""
    try:
        content: Any = parse_json(text)
        line: dict[str, Any] = dict(content)
        digests = dict(line.pop(DIGESTS))
        # A line without its line break was cut short, whatever its digest.
        if digests.pop("line") != _digest(line) or not text.endswith("\n"):
            return None
        if not (
            isinstance(line["number"], int) and all(isinstance(line[role], dict) for role in ROLES)
        ):
            return None
        matches = digests == {role: sha256(image_of(out, role, line["name"])) for role in ROLES}
    except (LookupError, OSError, TypeError, ValueError):
        return None
    return line if matches else None


def _digest(line: Line) -> str:
    """Return the hex digest of a line without its digests."""
    return hashlib.sha256(json.dumps(line, sort_keys=True).encode()).hexdigest()
