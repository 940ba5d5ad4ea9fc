"""Each band of an image may have its own sensor, and so a network of its own."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile

from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.bands import sensors_of
from tests.deploy.command_line import done, refused
from tests.model.raster import formats as images

FIRST = "pleiades-degraded"
SECOND = "blind"


def restored(image: Path, sensor: str, *more: str) -> tuple[np.ndarray, str]:
    out = image.with_name("out.tif")
    network = ("--network", "convbeers-xs", "--sensor", sensor)
    output = done("restore", image, out, "--overwrite", *network, *more)
    return tifffile.imread(out), output


@pytest.mark.parametrize("names", [("B0", "B1"), ("B1", "B0")])
def test_each_band_has_its_own_network(names: tuple[str, str], tmp_path: Path) -> None:
    """The bands of the file are B0 and B1, whatever the order of the option."""
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    of = dict(zip(names, (FIRST, SECOND), strict=True))
    result, _ = restored(image, f"{names[0]}={FIRST},{names[1]}={SECOND}", "--tile", "64")
    alone = {sensor: restored(image, sensor)[0] for sensor in (FIRST, SECOND)}
    assert (alone[FIRST] != alone[SECOND]).any()
    for band in (0, 1):
        np.testing.assert_array_equal(result[band], alone[of[f"B{band}"]][band])


def test_bands_without_names_are_used_in_order(tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "in.tif",
        images.digital_numbers(),
        planarconfig="separate",
        photometric="minisblack",
    )
    with open_raster(tmp_path / "in.tif") as source:
        assert source.raster.bands == 2
        assert source.raster.band_names == ()
    result, _ = restored(tmp_path / "in.tif", f"red={SECOND},blue={FIRST}")
    for band, sensor in ((0, SECOND), (1, FIRST)):
        np.testing.assert_array_equal(result[band], restored(tmp_path / "in.tif", sensor)[0][band])
    np.testing.assert_array_equal(
        restored(tmp_path / "in.tif", f"B1={FIRST},B0={SECOND}")[0], result
    )


def test_a_cog_names_the_sensors_in_the_order_of_the_bands(tmp_path: Path) -> None:
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    restored(image, f"B1={FIRST},B0={SECOND}", "--cog")
    with rasterio.open(tmp_path / "out.tif") as file:
        assert file.tags()["RESTORED_SENSOR"] == f"{SECOND}, {FIRST}"
        assert len(file.tags()["RESTORED_NETWORK_SHA256"].split(", ")) == 2


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
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    network = ("--network", "convbeers-xs", "--sensor", sensor)
    assert words in refused("restore", image, tmp_path / "out.tif", *network)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.tif"]


def test_one_profile_is_for_all_bands(tmp_path: Path) -> None:
    """The path of a file may have an equals sign in it."""
    path = Sensor.load(FIRST).save(tmp_path / "gain=2.toml")
    assert sensors_of(str(path)) == {"": Sensor.load(path)}
    assert sensors_of(FIRST) == {"": Sensor.load(FIRST)}
    with pytest.raises(OptionError):
        sensors_of("=a,B1=b")
