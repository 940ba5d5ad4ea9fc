"""Shipped networks by name wherever a network is taken."""

from pathlib import Path

import pytest

from deploy.shipped import VARIANT, default_int8, float_file, int8_file, shipped_pair


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-s", "convbeers-s-nominal"])
def test_a_name_is_the_shipped_network(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights, int8 = shipped_pair(name)
    assert int8_file(Path(name)) == int8_file(Path(f"{name}-int8")) == int8
    assert float_file(Path(name)) == weights
    assert weights.is_file()
    assert int8.is_file()
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(b"mine")  # a file of that name is what was meant
    assert int8_file(Path(name)) == float_file(Path(name)) == Path(name)


@pytest.mark.parametrize("given", ["none", "none.onnx", "folder/convbeers-s"])
def test_anything_else_stays_a_path(given: str) -> None:
    assert int8_file(Path(given)) == float_file(Path(given)) == Path(given)


def test_nothing_given_is_the_default() -> None:
    assert int8_file(None) == default_int8() == int8_file(Path(VARIANT))
