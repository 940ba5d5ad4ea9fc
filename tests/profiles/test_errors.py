"""Tests that errors survive pickling between processes and that their messages are readable."""

import sys
from importlib import import_module
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import (
    BeersError,
    ImageError,
    MachineError,
    MissingExtraError,
    ModelError,
    OptionError,
    ProfileError,
    missing_extra,
    optional,
    sizes,
    visible,
)


@pytest.mark.parametrize(
    "kind", [BeersError, ImageError, MachineError, ModelError, OptionError, ProfileError]
)
def test_an_error_survives_pickling_between_processes(kind: type[BeersError]) -> None:
    error = kind("a.tif has no rows. Give some.")
    received = ForkingPickler.loads(ForkingPickler.dumps(error))
    assert type(received) is kind
    assert str(received) == str(error) == "a.tif has no rows. Give some."


@given(st.lists(st.integers(0, 10**13), min_size=1, max_size=3))
@example([1, 2])
@example([310_000_000, 310_000_001])
@example([999_999, 1_000_000])
def test_sizes_that_differ_look_different(counts_bytes: list[int]) -> None:
    """A message must not read "needs 0.00 GB, but there is only 0.00 GB"."""
    texts = sizes(*counts_bytes)
    scales = {"GB": 1e9, "MB": 1e6, "kB": 1e3, "bytes": 1}
    assert len(set(texts)) == len(set(counts_bytes))
    for text, count in zip(texts, counts_bytes, strict=True):
        number, unit = text.split()
        assert float(number) * scales[unit] == pytest.approx(count, rel=0.005)


@given(st.text(max_size=40))
def test_visible_text_keeps_its_lines_but_no_control_characters(text: str) -> None:
    shown_text = visible(text)
    assert all(c.isprintable() or c in "\n\t" for c in shown_text)
    assert shown_text.count("\n") == text.count("\n")
    assert visible(shown_text) == shown_text


@pytest.mark.parametrize(
    "lacks", ["import dateutil_of_nobody", "raise ImportError('libexpat.so.1: no such file')"]
)
def test_a_package_that_cannot_load_gets_one_sentence(
    lacks: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pystac.py").write_text(lacks, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pystac", raising=False)
    with pytest.raises(
        MissingExtraError, match=r"^`cog` needs .*pystac.*does not load.*beers-deploy\[stac\]"
    ):
        optional("pystac", "cog")
    with pytest.raises(ImportError) as caught:
        import_module("pystac")
    assert "needs the package pystac" in str(missing_extra(caught.value, "train"))
    other = ImportError("no part of an extra")
    assert missing_extra(other, "train") is other
