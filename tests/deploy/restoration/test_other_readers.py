"""Tests that the system's QGIS reads the restored COG and runs our example of a tool."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.profiles.shipped import BLIND
from beers_deploy.verbs.restore import restore
from tests.model.raster import formats as images
from tests.project_files import ROOT
from tests.shipped import shipped_pair

PYTHON = Path("/usr/bin/python3")
"""The system's Python, because the packages of QGIS are in no virtual environment."""
PIXELS = np.tile(images.digital_numbers(), (1, 5, 6))
IN_QGIS = """
import json, os, runpy, sys
os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import *
application = QgsApplication([], False)
application.initQgis()
{}
sys.stdout.flush()
os._exit(0)  # a clean end crashes, because some objects outlive the application
"""
READ = """
layer = QgsRasterLayer(sys.argv[1], "restored", "gdal")
data, box = layer.dataProvider(), layer.extent()
bands = range(1, layer.bandCount() + 1)
blocks = [data.block(band, box, layer.width(), layer.height()) for band in bands]
grid = range(0, 90, 7)
values = [[[block.value(row, column) for column in grid] for row in grid] for block in blocks]
facts = {
    "valid": layer.isValid(),
    "crs": layer.crs().authid(),
    "box": [box.xMinimum(), box.yMaximum(), box.xMaximum(), box.yMinimum()],
    "names": [layer.bandName(band) for band in bands],
    "missing": [data.sourceNoDataValue(band) for band in bands if data.sourceHasNoDataValue(band)],
    "hole": [
        [blocks[0].isNoData(row, column) for column in (19, 20, 89, 90)] for row in (29, 30, 59, 60)
    ],
    "scales": [data.bandScale(band) for band in bands],
    "overviews": [[each.xDim, each.yDim] for each in data.buildPyramidList() if each.exists],
    "values": values,
}
print(json.dumps(facts))
"""

RUN = """
algorithm = runpy.run_path(sys.argv[1])["RestoreImage"]().create()
layer, context = QgsRasterLayer(sys.argv[3], "raw", "gdal"), QgsProcessingContext()
runs = []
for out in sys.argv[4:]:
    feedback = QgsProcessingFeedback()
    _, done = algorithm.run({"PROGRAM": sys.argv[2], "IMAGE": layer, "OUT": out}, context, feedback)
    runs.append([done, feedback.textLog()])
print(json.dumps({"runs": runs}))
"""


def answer(*command: str | Path) -> dict[str, Any]:
    """Return what a program prints as JSON."""
    process = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=True, timeout=300
    )
    content: dict[str, Any] = json.loads(process.stdout)
    return content


@pytest.fixture
def qgis() -> Path:
    """Return the path of a Python that has QGIS."""
    if (
        not PYTHON.is_file()
        or subprocess.run([PYTHON, "-c", "import qgis.core"], capture_output=True).returncode
    ):
        pytest.skip("no QGIS: apt-get install python3-qgis")
    return PYTHON


def restore_with_a_hole(folder: Path, model: Path) -> np.ndarray:
    """Restore an image with missing pixels into the COG out.tif, and return its pixels."""
    pixels = np.maximum(PIXELS, 1)
    pixels[:, 30:60, 20:90] = 0
    image = images.write_tiff(folder / "in.tif", pixels, nodata=0)
    restore(image, folder / "out.tif", network=model, cog=True)
    with rasterio.open(folder / "out.tif") as file:
        restored: np.ndarray = file.read()
    return restored


def test_qgis_reads_what_was_written(qgis: Path, model: Path, tmp_path: Path) -> None:
    restored = restore_with_a_hole(tmp_path, model)
    layer = answer(qgis, "-c", IN_QGIS.replace("{}", READ), tmp_path / "out.tif")
    place = images.profile()["transform"]
    _, height, width = restored.shape
    assert layer["valid"]
    assert layer["crs"] == "EPSG:32631"
    assert layer["box"] == pytest.approx(
        [*(place * (0, 0)), *(place * (width, height))], rel=0, abs=1e-9
    )
    assert layer["names"] == ["Band 1: B0", "Band 2: B1"]
    assert layer["missing"] == [0, 0]
    assert layer["hole"] == [[row and column for column in (0, 1, 1, 0)] for row in (0, 1, 1, 0)]
    assert layer["overviews"] == [[354, 375]]
    sampled = restored[:, :90:7, :90:7]
    # QGIS applies the bands' gains.
    physical = sampled * np.reshape(layer["scales"], (-1, 1, 1))
    present = sampled > 0
    assert_allclose(np.asarray(layer["values"])[present], physical[present], rtol=1e-6)
    assert layer["scales"] == [0.1, 0.2]


def test_qgis_s_toolbox_restores(qgis: Path, tmp_path: Path) -> None:
    """The script is an example for users. QGIS must report an error of the program."""
    image = images.write_tiff(tmp_path / "raw.tif", images.digital_numbers(bands=1))
    program = tmp_path / "beers-deploy"
    program.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m beers_deploy "$@"\n')
    program.chmod(0o755)
    script = ROOT / "examples/qgis_restore.py"
    outs = [tmp_path / "restored.tif", tmp_path / "restored.xyz"]
    (first_done, _), (second_done, log) = answer(
        qgis, "-c", IN_QGIS.replace("{}", RUN), script, program, image, *outs
    )["runs"]
    assert first_done
    assert not second_done
    assert "must have the name of a TIFF" in log
    restore(image, tmp_path / "expected.tif", network=shipped_pair(sensor=BLIND)[1])
    with rasterio.open(outs[0]) as ours, rasterio.open(tmp_path / "expected.tif") as theirs:
        assert_array_equal(ours.read(), theirs.read())
        assert ours.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
