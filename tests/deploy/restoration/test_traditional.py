"""Tests that the traditional pipeline restores a file to the pixels of the whole array."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.traditional.pipeline import TraditionalPipeline, restore_traditional
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done, refused
from tests.deploy.restoration.runs import PLANES, marked, names, restored
from tests.profiles.own_sensor import own_sensor

pytestmark = pytest.mark.usefixtures("unchecked")

SHAPE = (151, 37)
SENSOR = Sensor.load("pleiades-degraded")


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(300, 1500, SHAPE).astype(np.uint16)


def restore_array(pixels: np.ndarray, sensor: Sensor = SENSOR) -> np.ndarray:
    pipeline = TraditionalPipeline(sensor.nominal(), sensor.reference.nominal())
    return restore_traditional(torch.from_numpy(pixels.astype(np.float32)), pipeline).numpy()


def restore_file(
    folder: Path, pixels: np.ndarray, tags: dict[str, Any] | None = None, **options: Any
) -> np.ndarray:
    """Write pixels to a file and restore it, by default for the sensor of the tests."""
    chosen = {"method": "traditional", "sensor": SENSOR, **options}
    result, row = restored(folder, pixels, tags, **chosen)
    assert row.text["method"] == "traditional"
    assert names(folder) == ["in.tif", "out.tif"]
    return result


def other_sensor(folder: Path) -> Path:
    """Return the file of a sensor with another gain and 14 bits."""
    return own_sensor(
        folder, ("bits = { value = 12", "bits = { value = 14"), ("value = 10.2375", "value = 40.0")
    )


def test_a_file_gives_the_pixels_of_the_array(tmp_path: Path) -> None:
    expected = restore_array(noise())
    result = restore_file(tmp_path, noise(), {"rowsperstrip": 16, "compression": "zlib"})
    assert_array_equal(result, np.rint(expected).astype(np.uint16))
    by_array = restore(noise(), method="traditional", sensor=SENSOR)
    assert_array_equal(by_array, result)
    floats = restore_file(tmp_path, noise().astype(np.float32))
    assert_array_equal(floats, expected)
    # The pipeline changes the image by more than rounding.
    assert np.abs(expected - noise()).mean() > 10


def test_missing_pixels_stay(tmp_path: Path) -> None:
    pixels = noise()
    pixels[20:40, 5:9] = 7
    assert_array_equal(restore_file(tmp_path, pixels, marked(7)) == 7, pixels == 7)
    with_nan = np.where(pixels == 7, np.nan, pixels).astype(np.float32)
    assert_array_equal(restore_file(tmp_path, with_nan), restore_array(with_nan))


def test_bands_are_restored_one_by_one_each_for_its_sensor(tmp_path: Path) -> None:
    bands = np.stack([noise(0), noise(1)])
    for sensors in ({"": SENSOR}, {"B1": SENSOR, "B2": Sensor.load("dior-medium")}):
        results = restore_file(tmp_path, bands, PLANES, sensor=sensors)
        for band, pixels in enumerate(bands):
            sensor = list(sensors.values())[band % len(sensors)]
            expected = restore_array(pixels, sensor)
            assert_array_equal(results[band], np.rint(expected).astype(np.uint16))


def test_the_output_has_the_scale_of_the_input_whatever_the_gain(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    flat = np.full(SHAPE, 8000, np.uint16)
    result = restore_file(tmp_path / "files", flat, sensor=other_sensor(tmp_path))
    assert abs(float(result.mean()) / 8000 - 1) < 0.01
    shares = (noise() / 4095).astype(np.float32)
    result = restore_file(tmp_path / "files", shares, full_scale=1.0)
    assert_allclose(result * 4095, restore_array(noise()), atol=0.5)


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.full(SHAPE, 5000, np.uint16), "above full scale"),
        (np.full(SHAPE, 0.5, np.float32), "full_scale"),
        (np.full(SHAPE, np.nan, np.float32), "only NaN or nodata"),
    ],
)
def test_what_it_cannot_restore_leaves_the_old_output(
    pixels: np.ndarray, words: str, tmp_path: Path
) -> None:
    (tmp_path / "out.tif").write_bytes(b"the old one")
    with pytest.raises(ImageError, match=words):
        restore_file(tmp_path, pixels)
    assert (tmp_path / "out.tif").read_bytes() == b"the old one"
    assert names(tmp_path) == ["in.tif", "out.tif"]


def test_the_command_needs_a_sensor(tmp_path: Path) -> None:
    image = tmp_path / "in.tif"
    out = tmp_path / "out.tif"
    tifffile.imwrite(image, noise())
    command = f"restore {image} {out} --method traditional"
    needed = "--method traditional needs --sensor, the sensor that acquired the image"
    assert needed in refused(command)
    assert not out.exists()
    done(f"{command} --sensor {other_sensor(tmp_path)} --json {tmp_path}/a.json")
    assert tifffile.imread(out).shape == SHAPE
    assert '"sensor": "mine"' in (tmp_path / "a.json").read_text()
