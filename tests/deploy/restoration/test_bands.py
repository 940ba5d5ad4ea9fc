"""Tests that each band of an image may have its own sensor, and so a network of its own."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_array_equal

from beers_deploy.model.raster.facts import Raster
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.bands import in_order, sensors_of
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done, refused
from tests.deploy.restoration.runs import names
from tests.model.raster import formats as images

FIRST = "pleiades-degraded"
SECOND = "blind"


def test_each_named_band_has_its_own_network_whatever_the_order_of_the_option(
    tmp_path: Path,
) -> None:
    pixels = images.digital_numbers()
    image = images.write_tiff(tmp_path / "in.tif", pixels)
    out = tmp_path / "out.tif"
    done(f"restore {image} {out} --network convbeers-xs --sensor B1={FIRST},B0={SECOND} --cog")
    with rasterio.open(out) as file:
        assert file.tags()["RESTORED_SENSOR"] == f"{SECOND}, {FIRST}"
        digests = file.tags()["RESTORED_NETWORK_SHA256"].split(", ")
        result = file.read()
    assert len(set(digests)) == 2
    for band, sensor in enumerate((SECOND, FIRST)):
        alone = restore(pixels[band], network="convbeers-xs", sensor=sensor)
        assert_array_equal(result[band], alone)


def test_bands_without_names_are_used_by_their_number_or_in_order() -> None:
    unnamed = Raster(2, 9, 9, np.dtype(np.uint16))
    assert in_order({"red": "first", "blue": "second"}, unnamed) == ["first", "second"]
    assert in_order({"B1": "second", "B0": "first"}, unnamed) == ["first", "second"]
    by_name = sensors_of({"B1": FIRST, "B0": Sensor.load(SECOND)})
    assert by_name == sensors_of(f"B1={FIRST},B0={SECOND}")


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        (f"B0={FIRST}", "a sensor for each of 2 bands (B0, B1)"),
        (f"B0={FIRST},B7={FIRST}", "a sensor for each of 2 bands (B0, B1)"),
        (f"B0={FIRST},B0={SECOND}", "Name each band once"),
        (f"B0={FIRST},{SECOND}", "BAND=PROFILE"),
    ],
)
def test_what_does_not_fit_is_refused(sensor: str, words: str, tmp_path: Path) -> None:
    image = images.write_tiff(tmp_path / "in.tif")
    network = f"--network convbeers-xs --sensor {sensor}"
    assert words in refused(f"restore {image} {tmp_path}/out.tif {network}")
    assert names(tmp_path) == ["in.tif"]


def test_one_profile_is_for_all_bands(tmp_path: Path) -> None:
    """The path of a file may have an equals sign in it."""
    path = Sensor.load(FIRST).save(tmp_path / "gain=2.toml")
    assert sensors_of(str(path)) == {"": Sensor.load(path)}
    assert sensors_of(FIRST) == {"": Sensor.load(FIRST)}
    with pytest.raises(OptionError):
        sensors_of("=a,B1=b")
    with pytest.raises(OptionError, match="texts as names of bands, got 1"):
        sensors_of({1: FIRST, 2: SECOND})  # type: ignore[dict-item]
