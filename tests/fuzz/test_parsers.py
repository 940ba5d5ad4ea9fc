"""Tests that each parser reads a damaged file, or refuses it with one sentence.

Files are damaged by a fixed seed, or are arbitrary bytes. `BEERS_FUZZ=1000 pytest tests/fuzz`
damages a thousand times as many files, and BEERS_FUZZ_SEED=1 other ones. A file for which a test
fails stays in its temporary folder.
"""

import os
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from zlib import crc32

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import BeersError
from tests.fuzz.mutation import damaged
from tests.fuzz.parsers import PARSERS, Parser

EXECUTIONS = 60 * int(os.environ.get("BEERS_FUZZ", "1"))
ARBITRARY = 15
SEED = int(os.environ.get("BEERS_FUZZ_SEED", "0"))
CPU_S = 5.0
FREE_BYTES = 1 << 28
"""The free memory that parsers see. Those that ask may use much of it."""

BY_NAME = pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)


class TooLongError(BaseException):
    """Raised by the timer. No parser takes a BaseException for a fault of the file."""


@contextmanager
def limited_time() -> Iterator[None]:
    """Limit the process's CPU time, so that a busy machine causes no failure.

    Windows has no such timer.
    """

    def ring(*_: object) -> None:
        raise TooLongError

    with warnings.catch_warnings(action="ignore"):
        if sys.platform == "win32":
            yield
            return
        before = signal.signal(signal.SIGPROF, ring)
        signal.setitimer(signal.ITIMER_PROF, CPU_S)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, before)


def is_read(parser: Parser, content: bytes, folder: Path) -> bool:
    """Return True if a file is read, and False if it is refused with a sentence.

    The test fails on any other error, and if the parser changes the folder.
    """
    path = folder / "in" / f"file{parser.suffix}"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    refusal = None
    try:
        with limited_time():
            parser.parse(path)
    except BeersError as error:
        refusal = str(error)
    assert refusal is None or (refusal.isprintable() and len(refusal) <= 4000)
    assert sorted(folder.rglob("*")) == [path.parent, path]
    assert path.read_bytes() == content
    return refusal is None


@pytest.fixture(autouse=True)
def little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = SimpleNamespace(available=FREE_BYTES, total=FREE_BYTES)
    monkeypatch.setattr("psutil.virtual_memory", lambda: memory)


@pytest.fixture
def seeds(parser: Parser, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    return parser.seeds(tmp_path_factory.mktemp("seeds"))


@BY_NAME
def test_damaged_files_are_read_or_refused_with_a_sentence(
    parser: Parser, seeds: list[bytes], tmp_path: Path
) -> None:
    assert True in {is_read(parser, content, tmp_path) for content in seeds}
    for number in range(max(round(EXECUTIONS * parser.share), 10)):
        rng = np.random.default_rng([SEED, crc32(parser.name.encode()), number])
        content = damaged(seeds[int(rng.integers(len(seeds)))], seeds, parser.meaning, rng)
        is_read(parser, content, tmp_path)


@BY_NAME
def test_arbitrary_bytes_are_read_or_refused_with_a_sentence(
    parser: Parser, seeds: list[bytes], tmp_path: Path
) -> None:
    @settings(max_examples=ARBITRARY, derandomize=True, database=None)
    @given(
        st.one_of(
            st.binary(max_size=64),
            st.text(max_size=64).map(lambda text: text.encode("utf-8", "ignore")),
        )
    )
    def holds(content: bytes) -> None:
        for head in (b"", seeds[0][:12]):
            is_read(parser, head + content, tmp_path)

    holds()
