"""Each band of an image may have its own sensor, and so a network of its own."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from numpy.testing import assert_array_equal

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
    network = f"--network convbeers-xs --sensor {sensor}"
    output = done(f"restore {image} {out} --overwrite {network}", *more)
    return tifffile.imread(out), output


def test_each_named_band_has_its_own_network_whatever_the_order_of_the_option(
    tmp_path: Path,
) -> None:
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    result, _ = restored(image, f"B1={FIRST},B0={SECOND}", "--tile", "64", "--cog")
    with rasterio.open(tmp_path / "out.tif") as file:
        assert file.tags()["RESTORED_SENSOR"] == f"{SECOND}, {FIRST}"
        digests = file.tags()["RESTORED_NETWORK_SHA256"].split(", ")
        result = file.read()
    assert len(set(digests)) == 2
    for band, sensor in enumerate((SECOND, FIRST)):
        assert_array_equal(result[band], restored(image, sensor)[0][band])


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
        assert_array_equal(result[band], restored(tmp_path / "in.tif", sensor)[0][band])
    assert_array_equal(restored(tmp_path / "in.tif", f"B1={FIRST},B0={SECOND}")[0], result)
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
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    network = f"--network convbeers-xs --sensor {sensor}"
    assert words in refused(f"restore {image} {tmp_path}/out.tif {network}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.tif"]


def test_one_profile_is_for_all_bands(tmp_path: Path) -> None:
    """The path of a file may have an equals sign in it."""
    path = Sensor.load(FIRST).save(tmp_path / "gain=2.toml")
    assert sensors_of(str(path)) == {"": Sensor.load(path)}
    assert sensors_of(FIRST) == {"": Sensor.load(FIRST)}
    with pytest.raises(OptionError):
        sensors_of("=a,B1=b")
