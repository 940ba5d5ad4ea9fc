"""Each parser on files damaged by a fixed seed, and on arbitrary bytes; and whether a faulty one would be found."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.campaign import content_of
from tests.fuzz.execution import Finding, execute, little_memory
from tests.fuzz.parsers import PARSERS, Parser

EXECUTIONS, ARBITRARY = 60, 15
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
