"""Each parser on files damaged by a fixed seed, and on arbitrary bytes; and whether a faulty one would be found."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from profiles.errors import OptionError
from tests.fuzz.campaign import content_of
from tests.fuzz.execution import Finding, execute, little_memory
from tests.fuzz.mutation import damaged
from tests.fuzz.parsers import PARSERS, Parser

EXECUTIONS, ARBITRARY = 60, 15
NEEDS_TIMER = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no timer of a process's own time")
BY_NAME = pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)


def sound(parser: Parser, content: bytes, folder: Path) -> str:
    found = execute(parser.parse, content, folder / "in" / f"file{parser.suffix}")
    assert not isinstance(found, Finding), found.detail
    return found


@BY_NAME
def test_damaged_files_are_read_or_refused_by_a_sentence(
    parser: Parser, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    seeds = parser.seeds(tmp_path_factory.mktemp("seeds"))
    with little_memory():
        assert "read" in {sound(parser, content, tmp_path) for content in seeds}
        for number in range(max(round(EXECUTIONS * min(parser.share, 1)), 10)):
            sound(parser, content_of(parser, seeds, 0, number), tmp_path)


@BY_NAME
def test_arbitrary_bytes_are_refused_by_a_sentence(
    parser: Parser, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    seeds = parser.seeds(tmp_path_factory.mktemp("seeds"))

    @settings(max_examples=ARBITRARY, derandomize=True, database=None)
    @given(st.one_of(st.binary(max_size=64), st.text(max_size=64).map(lambda text: text.encode("utf-8", "ignore"))))
    def holds(content: bytes) -> None:
        for head in (b"", seeds[0][:12]):
            sound(parser, head + content, tmp_path)

    with little_memory():
        holds()


def hangs(_: Path) -> None:
    while True:
        pass


def writes(path: Path) -> None:
    (path.parent.parent / "escaped").touch()


def chatters(path: Path) -> None:
    raise OptionError(str(path), expected="a", got="b" * 5000, remedy="c" * 5000)


@pytest.mark.parametrize(
    ("parse", "kind"),
    [
        pytest.param(hangs, "more than", marks=NEEDS_TIMER),
        (writes, "wrote"),
        (chatters, "no sentence"),
        (lambda p: {}[p], "KeyError"),
    ],
)
def test_a_faulty_parser_is_a_finding(
    parse: Callable[[Path], object], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.fuzz.execution.CPU_S", 0.2)
    found = execute(parse, b"content", tmp_path / "in" / "file.txt")
    assert isinstance(found, Finding)
    assert kind in found.kind


@BY_NAME
def test_damage_is_the_same_for_the_same_seed_and_mostly_damage(parser: Parser, tmp_path: Path) -> None:
    seeds = parser.seeds(tmp_path)
    made = [content_of(parser, seeds, 3, number) for number in range(40)]
    assert made == [content_of(parser, seeds, 3, number) for number in range(40)]
    assert sum(content not in seeds for content in made) > 20


def test_damage_stays_small() -> None:
    rng = np.random.default_rng(0)
    assert max(len(damaged(b"a" * 300_000, [b"b"], None, rng)) for _ in range(50)) <= 1 << 18
