"""Tests that NumPy files are recognized by their content and that damage raises a ValueError."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.user_files.arrays import ALONE, load_arrays

ARRAYS = {"image": np.arange(40.0).reshape(4, 10), "reference": np.arange(7)}


def write_file(folder: Path, kind: str) -> Path:
    path = folder / "held.npy"
    with path.open("wb") as stream:
        if kind == "npy":
            np.save(stream, ARRAYS["image"])
        else:
            np.savez_compressed(stream, image=ARRAYS["image"], reference=ARRAYS["reference"])
    return path


def test_the_content_tells_an_archive_from_an_array(tmp_path: Path) -> None:
    np.testing.assert_array_equal(load_arrays(write_file(tmp_path, "npy"))[ALONE], ARRAYS["image"])
    arrays = load_arrays(write_file(tmp_path, "npz"))
    assert {name: values.shape for name, values in arrays.items()} == {
        "image": (4, 10),
        "reference": (7,),
    }


@given(
    kind=st.sampled_from(["npy", "npz"]),
    places=st.dictionaries(st.floats(0, 0.999), st.integers(0, 255), max_size=4),
)
def test_damaged_bytes_raise_nothing_but_a_value_error(
    kind: str, places: dict[float, int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = write_file(tmp_path_factory.mktemp("a"), kind)
    content = bytearray(path.read_bytes())
    for place, value in places.items():
        content[int(place * len(content))] = value
    path.write_bytes(content)
    try:
        load_arrays(path)
    except ValueError as error:
        assert str(error)  # noqa: PT017 - some damage changes nothing but a value


HEADERS = ["(((((", "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3)}"]
HEADERS += [
    f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({size},)}}" for size in (10**12, 10**20)
]


@pytest.mark.parametrize("header", HEADERS)
def test_an_impossible_header_is_a_value_error(header: str, tmp_path: Path) -> None:
    text = header.encode().ljust(117) + b"\n"
    (tmp_path / "x.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)
    with pytest.raises(ValueError, match="another format"):
        load_arrays(tmp_path / "x.npy")
