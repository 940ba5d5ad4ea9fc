"""Tests of full scale: what states it, and how values above it are clipped."""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_array_equal

from beers_deploy.model.raster.facts import Extent, Raster
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.radiometry import FullScale, Reading, full_scale_of
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import marked, restored
from tests.model.raster import formats as images

pytestmark = pytest.mark.usefixtures("unchecked")

SHAPE = 61, 47
Run = Callable[..., tuple[np.ndarray, Row, list[str]]]


def noise(bits: int) -> np.ndarray:
    return np.random.default_rng(bits).integers(1, 1 << bits, SHAPE).astype(np.uint16)


@pytest.fixture
def run(model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> Run:
    """Return a function that restores pixels in a file and returns result, row and log."""

    def run(pixels: np.ndarray, **options: Any) -> tuple[np.ndarray, Row, list[str]]:
        caplog.clear()
        with caplog.at_level(logging.INFO, "beers_deploy"):
            result, row = restored(tmp_path, pixels, network=model, tile=23, **options)
        return result, row, caplog.messages.copy()

    return run


def scale(
    raster: Raster, option: float | None = None, bits: int | None = None, largest: float = 0
) -> FullScale:
    sensors = {"": Sensor.load("pleiades-degraded").replace(bits=bits)} if bits else {}
    extents = [Extent(largest, whole=False)]
    return full_scale_of("x", raster, extents, Reading(sensors, full_scale=option))


def test_the_user_overrides_the_file_and_the_file_overrides_the_sensor() -> None:
    silent = Raster(1, 9, 9, np.dtype(np.uint16))
    ten_bits = replace(silent, bits=10)
    assert scale(ten_bits, 16383, 14) == FullScale(16383, "asked for")
    assert scale(ten_bits, None, 14) == FullScale(1023, "10 bits, as the file states")
    assert scale(silent, None, 14) == FullScale(16383, "14 bits, of the sensor")
    assert scale(silent) == FullScale(4095, "assumed: 12 bits", assumed=True)


def test_8_bit_pixels_need_a_stated_full_scale_of_at_most_255() -> None:
    eight = Raster(1, 9, 9, np.dtype(np.uint8))
    for bits in (None, 12):
        with pytest.raises(ImageError, match="8-bit pixels"):
            scale(eight, bits=bits)
    assert scale(eight, bits=8).value == 255
    assert scale(replace(eight, bits=6)).value == 63
    with pytest.raises(OptionError, match="at most 255 for uint8"):
        scale(eight, option=4095)


@pytest.mark.parametrize("bits", [10, 14])
def test_a_file_of_other_bits_is_restored_to_its_own_full_scale(
    bits: int, run: Run, model: Path, tmp_path: Path
) -> None:
    """An option, a sensor and the file itself give the same pixels, some above half of it."""
    full = 2**bits - 1
    pixels = images.digital_numbers(bits, bands=1)
    by_option, row, _ = run(pixels, full_scale=full)
    assert row.text["full scale from"] == "asked for"
    assert by_option.dtype == np.uint16
    assert full / 2 < by_option.max() <= full
    sensor = Sensor.load("pleiades-degraded").replace(bits=bits)
    by_sensor, row, _ = run(pixels, sensor=sensor, consistency=False)
    assert row.text["full scale from"] == f"{bits} bits, of the sensor"
    assert_array_equal(by_sensor, by_option)
    jp2 = images.write_jp2(tmp_path / "a.jp2", pixels, NBITS=bits)
    for image in (jp2, images.write_dimap(tmp_path / "DIM.XML", pixels, bits)):
        (row,) = restore(image, tmp_path / "out.tif", network=model, tile=23, overwrite=True).rows
        assert row.text["full scale from"] == f"{bits} bits, as the file states"
        assert_array_equal(tifffile.imread(tmp_path / "out.tif"), by_option)


def test_a_container_states_nothing_and_a_product_s_range_does(tmp_path: Path) -> None:
    pixels = images.digital_numbers()
    bits = []
    for image in (
        images.write_tiff(tmp_path / "a.tif", pixels),
        images.write_jp2(tmp_path / "a.jp2", pixels),
        images.write(tmp_path / "a.ntf", pixels, "NITF", ICORDS="N"),
        images.write(tmp_path / "b.ntf", pixels, "NITF", ICORDS="N", ABPP="12"),
        images.write_dimap(
            tmp_path / "DIM.XML",
            pixels,
            16,
            "<Dynamic_Range><PRODUCT_RANGE>12</PRODUCT_RANGE></Dynamic_Range>",
        ),
    ):
        with open_raster(image) as source:
            bits.append(source.raster.bits)
    assert bits == [None, None, None, 12, 12]


def test_values_above_a_stated_full_scale_are_clipped_counted_and_reported(run: Run) -> None:
    """Each is counted once, though tiles overlap, and restored as if it were full scale.

    Missing pixels are not counted.
    """
    pixels = noise(10)
    pixels[5:9, 3:40] = 5000
    pixels[30, 30] = 1024
    pixels[50, 3:9] = 65535
    clipped, row, messages = run(pixels, full_scale=1023, tags=marked(65535))
    assert row.figures["clipped pixels"].value == 4 * 37 + 1
    words = "149 pixels above full scale, 1023 (asked for), were clipped"
    assert sum(words in message for message in messages) == 1
    within = np.where(pixels == 65535, pixels, np.minimum(pixels, 1023))
    expected, row, messages = run(within, full_scale=1023, tags=marked(65535))
    assert_array_equal(clipped, expected)
    assert row.figures["clipped pixels"].value == 0
    assert not any("clipped" in message for message in messages)
    _, _, messages = run(noise(10), full_scale=255)
    (warning,) = (message for message in messages if "were clipped" in message)
    assert warning.endswith("% of the image; is that its full scale?")


def test_floats_of_digital_numbers_have_the_sensor_s_full_scale_and_shares_none() -> None:
    floats = Raster(1, 9, 9, np.dtype(np.float32))
    assert scale(floats, bits=10, largest=900.0).value == 1023
    with pytest.raises(ImageError, match="full_scale"):
        scale(floats, bits=10, largest=0.9)
