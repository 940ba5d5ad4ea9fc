"""Tests of `restore --interval`: half-widths of files and arrays, and refused inputs."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from numpy.testing import assert_allclose, assert_array_equal

import beers_deploy as bd
from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import load_network, save_network
from beers_deploy.model.io.tensors import read_weights
from beers_deploy.model.shipped import shipped_names, shipped_weights
from beers_deploy.network_files import int8_for_sensor
from beers_deploy.profiles.errors import MachineError, ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.interval import interval_of
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import (
    NAME,
    TRANSFORM,
    names,
    pair_of_bands,
    stopped_after,
)
from tests.model.networks import plain
from tests.quant.quick import one_guess, uniform

pytestmark = pytest.mark.usefixtures("unchecked")

NETWORK = "convbeers-xs-int8"
OPTIONS: dict[str, Any] = {"network": NETWORK, "sensor": NAME, "interval": 90}


def run(image: Path, out: Path, **options: Any) -> bytes:
    """Restore an image with half-widths, and return the bytes of their file."""
    table = restore(image, out, overwrite=True, progress=False, **{**OPTIONS, **options})
    written = out.with_name(f"{out.stem}-interval.tif")
    assert table.title == f"wrote {out} and {written}"
    return written.read_bytes()


def half_widths(out: Path) -> np.ndarray:
    """Return the planes of the file next to an output."""
    with rasterio.open(out.with_name(f"{out.stem}-interval.tif")) as file:
        return np.asarray(file.read())


def test_the_file_is_georeferenced_and_has_a_plane_for_each_band(
    image: Path, tmp_path: Path
) -> None:
    """Half-widths are positive floats where a pixel is known, and NaN where it is missing."""
    run(image, tmp_path / "out.tif")
    with rasterio.open(tmp_path / "out-interval.tif") as file:
        blue, red = file.read()
        assert file.descriptions == ("blue: half-width", "red: half-width")
        assert file.tags(1)["level_percent"] == "90"
        assert (file.crs, file.transform) == ("EPSG:32631", TRANSFORM)
        assert np.isnan(file.nodata)
    assert blue.dtype == np.float32
    assert (blue > 0).all()
    missing = np.zeros(blue.shape, bool)
    missing[:64, :64] = True
    assert_array_equal(np.isnan(red), missing)
    # Far from the missing pixels both bands are nearly the same image.
    assert_allclose(red[:, 150:], blue[:, 150:], rtol=0.05)


@pytest.mark.slow
def test_tiles_and_stops_change_no_byte(image: Path, tmp_path: Path) -> None:
    whole = run(image, tmp_path / "whole.tif", tile=512)
    assert run(image, tmp_path / "tiles.tif", tile=64) == whole
    out = tmp_path / "stopped.tif"
    with stopped_after(9):
        restore(image, out, tile=64, **OPTIONS)
    assert not (tmp_path / "stopped-interval.tif").exists()
    assert run(image, out, tile=64, resume=True) == whole
    # Negative control: another level has other half-widths.
    assert run(image, tmp_path / "other.tif", interval=50) != whole


def test_bands_have_the_half_widths_of_their_own_sensors(image: Path, tmp_path: Path) -> None:
    """The same pixels are restored with less certainty for a sensor with more blur."""
    blurred = Sensor.load(NAME).replace(mtf_nyquist=0.03)
    run(image, tmp_path / "out.tif", sensor={"blue": Sensor.load(NAME), "red": blurred})
    run(image, tmp_path / "alike.tif")
    blue, red = half_widths(tmp_path / "out.tif")
    assert_array_equal(half_widths(tmp_path / "alike.tif")[0], blue)
    assert np.nanmean(red) > 1.2 * np.nanmean(blue)


def test_an_array_has_the_half_widths_of_the_file(image: Path, tmp_path: Path) -> None:
    run(image, tmp_path / "out.tif")
    of_file = half_widths(tmp_path / "out.tif")[0]
    band = pair_of_bands().degraded[:150]
    restored, half = bd.restore(band, **OPTIONS)
    assert_array_equal(half, of_file)
    assert_array_equal(restored, bd.restore(band, network=NETWORK, sensor=NAME))
    _, of_torch = bd.restore(torch.from_numpy(band.astype(np.int32)), **OPTIONS)
    assert_array_equal(of_torch.numpy(), half)
    hidden = np.zeros(band.shape, bool)
    hidden[:5] = True
    for each in bd.restore(np.ma.array(band, mask=hidden), **OPTIONS):
        assert_array_equal(np.ma.getmaskarray(each), hidden)
    dask = pytest.importorskip("dask.array", reason="dask is not installed")
    with pytest.raises(OptionError, match="Compute the Dask array"):
        bd.restore(dask.from_array(band), **OPTIONS)


def test_most_errors_of_a_drawn_scene_lie_within_the_interval() -> None:
    """Drawn scenes are no photographs, so only the order of levels and a wide range are checked."""
    pair = pair_of_bands()
    shares = []
    for level in (50, 90):
        restored, half = bd.restore(
            pair.degraded, network=NETWORK, sensor=pair.profiles[0], interval=level
        )
        error = np.abs(restored.astype(np.float64) - pair.clean)
        shares.append(float((error <= half)[16:-16, 16:-16].mean()))
    assert 0.3 < shares[0] < shares[1]
    assert 0.7 < shares[1] < 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensor": "blind"}, "needs the sensor of every band"),
        ({"sensor": "blind", "dry_run": True}, "needs the sensor of every band"),
        ({"sensor": f"blue=blind,red={NAME}"}, "needs the sensor of every band"),
        ({"interval": 91}, "must be one of 50, 68, 80, 90, 95, 99, got 91"),
    ],
)
def test_options_without_an_interval_are_refused_before_a_file_is_written(
    options: dict[str, Any], words: str, image: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=words):
        run(image, tmp_path / "out.tif", **options)
    assert names(tmp_path) == []


def test_a_network_without_an_interval_is_refused(image: Path, tmp_path: Path) -> None:
    network = bd.Network.load(NETWORK, sensor=NAME)
    (item,) = (item for item in network.model.metadata_props if item.key == "interval")
    network.model.metadata_props.remove(item)
    path = bd.Network(network.model, "mine").save(tmp_path / "mine.onnx")
    with pytest.raises(ModelError, match="has no calibrated interval"):
        run(image, tmp_path / "out.tif", network=path)
    assert names(tmp_path) == ["mine.onnx"]


def test_the_space_for_the_half_widths_is_checked_before_the_run(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two bands of 150 x 214: rows and tiles of 16 bits, and tiles of float32.
    needed = 2 * (150 * 214 * 2 + 256**2 * (2 + 4))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=needed - 1))
    with pytest.raises(MachineError, match="disk space"):
        run(image, tmp_path / "out.tif")
    assert names(tmp_path) == []
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=needed))
    assert run(image, tmp_path / "out.tif")


@pytest.mark.parametrize("name", ["out-interval.tif", "blocks.tif", "page.html"])
def test_an_older_file_is_not_replaced(name: str, image: Path, tmp_path: Path) -> None:
    older = tmp_path / name
    older.write_bytes(b"older")
    beside: dict[str, Any] = {
        "self_check": tmp_path / "blocks.tif",
        "view": tmp_path / "page.html",
    }
    with pytest.raises(OptionError, match=f"{name} exists already"):
        restore(image, tmp_path / "out.tif", **beside, **OPTIONS)
    assert older.read_bytes() == b"older"
    assert [*tmp_path.iterdir()] == [older]


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_networks_have_an_interval_that_another_sensor_keeps(name: str) -> None:
    """Float and INT8 have different intervals. Conditioning on another sensor keeps them."""
    levels = [50, 68, 80, 90, 95, 99]
    own = [interval_of(bd.Network.load(each, sensor=NAME)) for each in (name, f"{name}-int8")]
    assert [list(interval.quantiles) for interval in own] == [levels, levels]
    assert own[0] != own[1]
    model = bd.Network.load(f"{name}-int8", sensor=NAME).model
    other = int8_for_sensor(model, Sensor.load("dior-medium"))
    assert metadata(other)["interval"] == metadata(model)["interval"]


def test_other_weights_do_not_inherit_the_interval(tmp_path: Path) -> None:
    """Weights that are saved again have none, and neither has a quantized float network."""
    source = shipped_weights("convbeers-xs")
    assert read_weights(source).interval
    network, recipe = load_network(source)
    save_network(tmp_path / "w.safetensors", network, recipe)
    assert not read_weights(tmp_path / "w.safetensors").interval
    model = to_onnx(plain(), {"interval": "of the float network"})
    samples = uniform(2, 1, 48, 48)
    with one_guess():
        int8 = bd.quantize(model, samples=samples)
    assert "interval" not in metadata(int8.model)
