"""The files of the project outside the package, which tests read."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def text_of(name: str) -> str:
    """Return the text of a file by its path from the root of the project."""
    return (ROOT / name).read_text(encoding="utf-8")
