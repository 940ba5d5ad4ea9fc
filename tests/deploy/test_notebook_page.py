"""Test that the code of docs/how-to/notebook.md runs and gives the results of the command."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_array_equal

import beers_deploy as bd
from beers_deploy.profiles.shipped import BLIND, profile_path
from beers_deploy.verbs.restore import restore
from tests.project_files import text_of
from tests.shipped import shipped_pair

NET = """
import torch


class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.head = torch.nn.Conv2d(1, 8, 3, padding=1)
        self.tail = torch.nn.Conv2d(8, 1, 3, padding=1)
        for weight in self.parameters():
            weight.data = 0.1 * torch.randn(weight.shape, generator=generator)

    def forward(self, image):
        return image + self.tail(torch.relu(self.head(image)))
"""


# The warning comes from the use of affine by rioxarray.
@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_the_page_gives_what_the_command_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rasterio = pytest.importorskip("rasterio", reason="no rasterio and no rioxarray")
    pytest.importorskip("rioxarray", reason="no rioxarray")
    monkeypatch.chdir(tmp_path)
    pixels = np.random.default_rng(0).integers(1, 4096, (1, 300, 260)).astype(np.uint16)
    pixels[:, 40:90, 50:120] = 0
    about = {
        "crs": "EPSG:32631",
        "transform": rasterio.Affine(0.5, 0, 3e5, 0, -0.5, 4.8e6),
        "nodata": 0,
    }
    with rasterio.open("raw.tif", "w", "GTiff", 260, 300, 1, dtype="uint16", **about) as file:
        file.write(pixels)
    shutil.copy(profile_path("sensors", "pleiades-degraded"), "my-sensor.toml")
    Path("my_net.py").write_text(NET)
    for stranger in ("model", "quant", "profiles", "deploy"):
        Path(f"{stranger}.py").write_text("raise RuntimeError('a module of the user')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", text_of("docs/how-to/notebook.md"), re.DOTALL):
        exec(code, names)  # noqa: S102 - our own page
    restore(Path("raw.tif"), Path("expected.tif"), network=shipped_pair(sensor=BLIND)[1])
    expected = tifffile.imread("expected.tif")
    with rasterio.open("restored.tif") as ours, rasterio.open("expected.tif") as theirs:
        assert_array_equal(ours.read(1), expected)
        assert (ours.crs, ours.transform, ours.nodata) == (
            theirs.crs,
            theirs.transform,
            theirs.nodata,
        )
    names["test_int8_stays_close_to_float"]()
    assert names["int8"] == bd.Network.load("int8.onnx")
    psnrs_db = [names["pair"].psnr(names["images"][name]) for name in ("raw", "chain", "network")]
    assert psnrs_db == sorted(psnrs_db)
    assert list(names["table"].columns[:1]) == ["tiles"]
    assert_array_equal(names["corner"].values, expected[:200, :200])
    assert_array_equal(names["whole"][0], expected)
    assert_array_equal(tifffile.imread(names["run"].path), expected)
