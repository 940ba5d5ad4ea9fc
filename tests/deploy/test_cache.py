"""Kept measurements: unchanged ones are found, changed ones and damaged ones are measured again."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from deploy import cache as cache_module
from deploy.cache import Cache, code_digest, digest_of, pixels_digest


@dataclass(frozen=True)
class Length:
    """A measurement."""

    value: float

    def to_json(self) -> dict[str, object]:
        return {"value": self.value}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        return cls(float(stored["value"]))


class Ruler:
    """Counts how often it measures."""

    def __init__(self) -> None:
        self.used = 0

    def __call__(self) -> Length:
        self.used += 1
        return Length(1.5)


KEY = {"model": "abc", "halo": 8}


def test_what_is_unchanged_is_measured_once_and_what_changed_again(tmp_path: Path) -> None:
    cache, ruler = Cache(tmp_path), Ruler()
    assert cache.make("length", KEY, Length, ruler) == cache.make(
        "length", dict(reversed(KEY.items())), Length, ruler
    )
    assert ruler.used == 1
    cache.make("length", {**KEY, "halo": 9}, Length, ruler)
    cache.make("width", KEY, Length, ruler)
    assert ruler.used == 3


@pytest.mark.parametrize("damage", ["", "{", "[]", "null", '{"value": 2}', "cut", "changed", "folder"])
def test_a_damaged_file_is_measured_again(damage: str, tmp_path: Path) -> None:
    cache, ruler = Cache(tmp_path), Ruler()
    cache.make("length", KEY, Length, ruler)
    path = cache.path("length", KEY)
    text = path.read_text()
    if damage == "folder":
        path.unlink()
    else:
        spoilt = {"cut": text[: len(text) // 2], "changed": text.replace("1.5", "2.5")}
        path.write_text(spoilt.get(damage, damage))
    assert cache.find("length", KEY, Length) is None
    assert cache.make("length", KEY, Length, ruler) == Length(1.5)
    assert ruler.used == 2
    assert cache.find("length", KEY, Length) == Length(1.5)


def test_a_file_says_what_it_depends_on(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    cache.keep("length", KEY, Length(2))
    assert json.loads(cache.path("length", KEY).read_text())["key"] == KEY
    assert [path.name for path in tmp_path.iterdir()] == [cache.path("length", KEY).name]


def test_pixels_sizes_and_types_all_count() -> None:
    image = np.arange(12, dtype=np.float32)
    assert pixels_digest([image]) == pixels_digest([image.copy()])
    others: list[list[np.ndarray]] = [
        [image.reshape(3, 4)],
        [image.reshape(4, 3)],
        [image + 1],
        [image.astype(np.float64)],
        [image, image],
        [],
    ]
    digests = {pixels_digest([image]), *map(pixels_digest, others)}
    assert len(digests) == 1 + len(others)


def test_digests_of_plain_values_know_no_order_of_keys() -> None:
    assert digest_of({"a": 1, "b": [2]}) == digest_of({"b": [2], "a": 1})
    assert digest_of({"a": 1}) != digest_of({"a": 2})


def test_other_code_is_another_measurement_however_far_it_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = tmp_path / "tool"
    tool.mkdir()
    (tool / "__init__.py").write_text("")
    (tool / "one.py").write_text("def late():\n    from tool import two\n")
    (tool / "two.py").write_text("import json\nimport tool.three as three\n")
    (tool / "other.py").write_text("x = 1\n")
    monkeypatch.setattr(cache_module, "ROOT", tmp_path)
    digests = []
    for changed, text in (("three", "x = 1\n"), ("three", "x = 2\n"), ("other", "x = 2\n")):
        (tool / f"{changed}.py").write_text(text)
        code_digest.cache_clear()
        digests.append(code_digest("tool.one"))
    code_digest.cache_clear()
    assert digests[0] != digests[1]
    assert digests[1] == digests[2]


def test_what_is_measured_depends_on_the_metrics_and_the_network_runner() -> None:
    from deploy.tradeoff.accuracy import measure

    found = {path.relative_to(cache_module.ROOT).as_posix() for path in cache_module._sources([measure.__module__])}
    assert {"model/metrics/fidelity.py", "deploy/restoration/engine.py", "deploy/tradeoff/accuracy.py"} <= found
