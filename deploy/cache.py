"""Measurements kept by what they depend on: a small file each, written whole; a damaged one is measured again."""

import ast
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from model.io.files import write_text

ROOT = Path(__file__).resolve().parents[1]

Key = Mapping[str, object]
"""Everything that a measurement depends on, by name: digests of inputs, options, code, runtime."""


class Keepable(Protocol):
    """What survives a round through JSON."""

    def to_json(self) -> Mapping[str, object]:
        """Plain values."""
        ...

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """The inverse; raises KeyError, TypeError or ValueError on anything else."""
        ...


T = TypeVar("T", bound=Keepable)


@dataclass(frozen=True)
class Cache:
    """A folder of measurements; what nothing asks for any more may be deleted."""

    folder: Path

    def find(self, kind: str, key: Key, what: type[T]) -> T | None:
        """The measurement made under that key, or None where there is none, or a damaged one."""
        try:
            stored = json.loads(self.path(kind, key).read_text(encoding="utf-8"))
            whole = stored["sha256"] == digest_of(stored["value"])
            return what.from_json(stored["value"]) if whole else None
        except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError):
            return None

    def keep(self, kind: str, key: Key, value: Keepable) -> None:
        """Write a measurement, whole or not at all."""
        plain = json.loads(json.dumps(value.to_json()))
        stored = {"key": dict(key), "value": plain, "sha256": digest_of(plain)}
        write_text(self.path(kind, key), json.dumps(stored, indent=1, default=str) + "\n")

    def make(self, kind: str, key: Key, what: type[T], measure: Callable[[], T]) -> T:
        """The measurement under that key; measured and kept where there is none."""
        found = self.find(kind, key, what)
        if found is None:
            found = measure()
            self.keep(kind, key, found)
        return found

    def path(self, kind: str, key: Key, suffix: str = "json") -> Path:
        """Where a measurement, or a file made on the way to it, is kept."""
        return self.folder / f"{kind}-{digest_of(key)[:24]}.{suffix}"


def digest_of(value: object) -> str:
    """SHA-256 of plain values, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def pixels_digest(images: Iterable[np.ndarray]) -> str:
    """SHA-256 of the pixels, sizes and types of images."""
    digest = hashlib.sha256()
    for image in images:
        digest.update(f"{image.shape} {image.dtype}".encode())
        digest.update(np.ascontiguousarray(image).tobytes())
    return digest.hexdigest()


@cache
def code_digest(*names: str) -> str:
    """SHA-256 of the sources of modules and of all of ours that they import: other code measures something else."""
    digest = hashlib.sha256()
    for path in sorted(_sources(names)):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _sources(names: Iterable[str]) -> set[Path]:
    """The files of modules by name, and of what they import from this installation, wherever in them that stands."""
    found: set[Path] = set()
    waiting = list(names)
    while waiting:
        path = _source(waiting.pop())
        if path is not None and path not in found:
            found.add(path)
            waiting += _imported(path)
    return found


def _source(name: str) -> Path | None:
    place = ROOT / name.replace(".", "/")
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
