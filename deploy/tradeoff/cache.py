"""Measurements kept by what they depend on: a small file each, written whole; a damaged one is measured again."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from model.files import write_text

ROOT = Path(__file__).resolve().parents[2]

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
    """SHA-256 of the sources of modules, or of all modules of packages: other code measures something else."""
    digest = hashlib.sha256()
    for name in names:
        place = ROOT / name.replace(".", "/")
        for path in sorted(place.glob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
            digest.update(path.read_bytes())
    return digest.hexdigest()
