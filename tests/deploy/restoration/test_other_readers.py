"""The restored COG in programs that are not ours: gdalinfo, and QGIS's own reader, both of the system."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.restoration.options import Options
from deploy.restoration.run import restore_file
from tests.deploy.restoration import images

PYTHON = Path("/usr/bin/python3")
"""Of the system: packages of QGIS belong to no virtual environment."""
PIXELS = np.tile(images.digital_numbers(), (1, 5, 6))
READ_IN_QGIS = """
import json, os, sys
os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import QgsApplication, QgsRasterLayer
application = QgsApplication([], False)
application.initQgis()
layer = QgsRasterLayer(sys.argv[1], "restored", "gdal")
data, box = layer.dataProvider(), layer.extent()
bands = range(1, layer.bandCount() + 1)
blocks = [data.block(band, box, layer.width(), layer.height()) for band in bands]
values = [[[block.value(row, column) for column in range(0, 90, 7)] for row in range(0, 90, 7)] for block in blocks]
said = {
    "valid": layer.isValid(),
    "crs": layer.crs().authid(),
    "box": [box.xMinimum(), box.yMaximum(), box.xMaximum(), box.yMinimum()],
    "names": [layer.bandName(band) for band in bands],
    "missing": [data.sourceNoDataValue(band) for band in bands if data.sourceHasNoDataValue(band)],
    "hole": [[blocks[0].isNoData(row, column) for column in (19, 20, 89, 90)] for row in (29, 30, 59, 60)],
    "scales": [data.bandScale(band) for band in bands],
    "overviews": [[each.xDim, each.yDim] for each in data.buildPyramidList() if each.exists],
    "values": values,
}
print(json.dumps(said))
del blocks, data, layer
application.exitQgis()
"""


def answer(*command: str | Path) -> dict[str, Any]:
    """What a program prints as JSON."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True, timeout=120)
    said: dict[str, Any] = json.loads(done.stdout)
    return said


@pytest.fixture
def gdalinfo() -> str:
    """The path of the program."""
    if (found := shutil.which("gdalinfo")) is None:
        pytest.skip("no gdalinfo: apt-get install gdal-bin")
    return found


@pytest.fixture
def qgis() -> Path:
    """A Python that has QGIS."""
    if not PYTHON.is_file() or subprocess.run([PYTHON, "-c", "import qgis.core"], capture_output=True).returncode:
        pytest.skip("no QGIS: apt-get install python3-qgis")
    return PYTHON


@pytest.mark.parametrize("name", ["a.tif", "a.jp2", "a.vrt", "DIM.XML"])
def test_gdalinfo_finds_it_where_the_input_was(name: str, gdalinfo: str, model: Path, tmp_path: Path) -> None:
    image = images.FORMATS[name](tmp_path / name, images.digital_numbers())
    restore_file(image, tmp_path / "out.tif", Options(model, cog=True), lambda _: None)
    before, after = (answer(gdalinfo, "-json", path) for path in (image, tmp_path / "out.tif"))
    assert after["geoTransform"] == pytest.approx(before["geoTransform"], rel=0, abs=1e-9)
    for corner, place in before["cornerCoordinates"].items():
        assert after["cornerCoordinates"][corner] == pytest.approx(place, rel=0, abs=1e-9)
    assert after["coordinateSystem"]["wkt"].splitlines()[-1].strip() == 'ID["EPSG",32631]]'
    assert after["size"] == before["size"]
    assert after["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    assert after["metadata"][""]["RESTORED_BY"].startswith("beers-deploy ")
    for key, text in before["metadata"].get("RPC", {}).items():
        if key not in ("ERR_BIAS", "ERR_RAND"):  # GeoTIFF's tag has places for both, a DIMAP's model other ones
            numbers = [[float(word) for word in said.split()] for said in (text, after["metadata"]["RPC"][key])]
            assert numbers[1] == pytest.approx(numbers[0], rel=0, abs=1e-9)
    assert ("RPC" in before["metadata"]) == (name == "DIM.XML")


def test_gdalinfo_finds_bands_nodata_and_overviews(gdalinfo: str, model: Path, tmp_path: Path) -> None:
    restore_with_a_hole(tmp_path, model)
    bands = answer(gdalinfo, "-json", tmp_path / "out.tif")["bands"]
    assert [band["description"] for band in bands] == ["B0", "B1"]
    assert [band["scale"] for band in bands] == [0.1, 0.2]
    assert [band["noDataValue"] for band in bands] == [0, 0]
    assert [[each["size"] for each in band["overviews"]] for band in bands] == [[[354, 375]]] * 2


def restore_with_a_hole(folder: Path, model: Path) -> np.ndarray:
    """Restore an image that misses pixels into the COG out.tif; its pixels."""
    pixels = np.maximum(PIXELS, 1)
    pixels[:, 30:60, 20:90] = 0
    image = images.write_tiff(folder / "in.tif", pixels, nodata=0)
    restore_file(image, folder / "out.tif", Options(model, cog=True), lambda _: None)
    with images.rasterio.open(folder / "out.tif") as file:
        restored: np.ndarray = file.read()
    return restored


def test_qgis_shows_what_was_written(qgis: Path, model: Path, tmp_path: Path) -> None:
    restored = restore_with_a_hole(tmp_path, model)
    said = answer(qgis, "-c", READ_IN_QGIS, tmp_path / "out.tif")
    place, (_, height, width) = images.profile()["transform"], restored.shape
    assert said["valid"]
    assert said["crs"] == "EPSG:32631"
    assert said["box"] == pytest.approx([*(place * (0, 0)), *(place * (width, height))], rel=0, abs=1e-9)
    assert said["names"] == ["Band 1: B0", "Band 2: B1"]
    assert said["missing"] == [0, 0]
    assert said["hole"] == [[row and column for column in (0, 1, 1, 0)] for row in (0, 1, 1, 0)]
    assert said["overviews"] == [[354, 375]]
    physical = restored[:, :90:7, :90:7] * np.reshape(said["scales"], (-1, 1, 1))  # it applies the bands' gains
    known = restored[:, :90:7, :90:7] > 0
    np.testing.assert_allclose(np.asarray(said["values"])[known], physical[known], rtol=1e-6)
    assert said["scales"] == [0.1, 0.2]
