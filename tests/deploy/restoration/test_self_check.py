"""Tests of the self-check of `restore`: its report, its errors and its map."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from numpy.testing import assert_array_equal

import beers_deploy as bd
from beers_deploy.model.self_check import BLOCK_PX, MOST_CHI2, Judged
from beers_deploy.profiles.errors import ImageError, MachineError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration import run as run_module
from beers_deploy.restoration.self_check import BlockMap
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import NAME, TRANSFORM, names, noise

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.fixture(scope="module")
def other_network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a network for a far sharper sensor."""
    sharp = Sensor.load(NAME).replace(mtf_nyquist=0.15)
    path = tmp_path_factory.mktemp("network") / "other.onnx"
    bd.Network.load("convbeers-xs", sensor=sharp).save(path)
    return path


def run(image: Path, out: Path, **options: Any) -> Row:
    """Restore the image of a known sensor, and return the row of its first band."""
    rows: Sequence[Row] = restore(
        image, out, sensor=NAME, overwrite=True, progress=False, **options
    ).rows
    return rows[0]


def test_a_right_restoration_is_within_the_bound_and_its_map_is_georeferenced(
    image: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A right restoration passes even with `strict`, and its map is georeferenced block by block.

    Missing pixels of one band leave the other band as it is.
    """
    path = tmp_path / "map.tif"
    row = run(image, tmp_path / "out.tif", network="convbeers-xs", self_check=path, strict=True)
    assert row.figures["self-check outside"].value == 0
    assert row.figures["self-check"].mode == "measured"
    assert "self-check" not in caplog.text
    with rasterio.open(path) as file:
        chi2, state, chi2_red, state_red = file.read()
        assert file.descriptions == ("blue: chi2", "blue: state", "red: chi2", "red: state")
        assert file.crs == "EPSG:32631"
        assert_array_equal(file.transform, TRANSFORM * rasterio.Affine.scale(BLOCK_PX))
    assert chi2.shape == (3, 4)
    # The last blocks of a row and of a column have too few pixels.
    known = np.isfinite(chi2)
    assert_array_equal(known, np.isfinite(state))
    assert 0.1 < chi2[known].min() < chi2[known].max() < MOST_CHI2
    assert np.isnan(chi2_red[0, 0])
    assert np.isnan(state_red[0, 0])
    # Far from the missing pixels both bands are the same image.
    assert_array_equal(chi2_red[2:, 3], chi2[2:, 3])
    undecided = 100 * np.mean(
        np.concatenate([state[known], state_red[np.isfinite(state_red)]]) == 2
    )
    assert row.figures["self-check not decidable"].value == pytest.approx(undecided)


def test_an_image_without_a_block_to_compare_has_no_share_of_blocks(tmp_path: Path) -> None:
    """A share of no block is not 0 %, which would mean that the image was checked."""
    tifffile.imwrite(tmp_path / "in.tif", noise(40, 70))
    row = run(tmp_path / "in.tif", tmp_path / "out.tif", network="convbeers-xs")
    for name in ("self-check outside", "self-check not decidable"):
        assert row.figures[name].value is None
    assert BlockMap({0: Judged(np.ones((1, 1)), np.zeros((1, 1)))}).figures[
        "self-check not decidable"
    ].value == pytest.approx(100)


def test_a_network_for_another_sensor_is_reported(
    image: Path, other_network: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A network for a sharper sensor fails the check: a warning, and with `strict` an error.

    After the error neither the image nor the map is left in the folder.
    """
    out = tmp_path / "out.tif"
    with caplog.at_level(logging.WARNING):
        row = run(image, out, network=other_network)
    assert (row.figures["self-check outside"].value or 0) > 50
    assert "the result fails the self-check" in caplog.text
    assert "`sensor` acquired the image" in caplog.text
    strict = tmp_path / "strict.tif"
    with pytest.raises(
        ImageError, match=r"restoration fails the self-check: .* contradict the raw"
    ):
        run(image, strict, network=other_network, strict=True, self_check=tmp_path / "map.tif")
    assert names(tmp_path) == ["out.tif"]


def test_a_map_that_cannot_be_written_leaves_the_old_image_and_a_run_to_resume(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise MachineError("No space left on device.")

    out = tmp_path / "out.tif"
    out.write_bytes(b"old")
    options: dict[str, Any] = {"network": "convbeers-xs", "self_check": tmp_path / "map.tif"}
    monkeypatch.setattr(run_module, "write_map", full)
    with pytest.raises(MachineError, match="No space left"):
        run(image, out, **options)
    assert out.read_bytes() == b"old"
    monkeypatch.undo()
    # No pixel is left to restore.
    assert run(image, out, resume=True, **options).figures["throughput"].value == 0
    assert out.read_bytes() != b"old"


def test_the_traditional_pipeline_is_checked_too(image: Path, tmp_path: Path) -> None:
    """The check judges results by any method, since it reads the images alone."""
    row = run(image, tmp_path / "out.tif", method="traditional", quality="fast")
    assert row.figures["self-check outside"].value == 0


def test_without_a_known_sensor_there_is_no_check(image: Path, tmp_path: Path) -> None:
    """Without a sensor there is no noise to compare with, so no figure is made up.

    To ask for a map of a check that is not made is an error, and no image is written.
    """
    (row,) = restore(image, tmp_path / "out.tif", network="convbeers-xs", progress=False).rows
    assert not any("self-check" in name for name in row.figures)
    with pytest.raises(OptionError, match="needs a known sensor"):
        restore(
            image, tmp_path / "2.tif", network="convbeers-xs", self_check=tmp_path / "map.tif",
            progress=False,
        )  # fmt: skip
    assert not (tmp_path / "2.tif").exists()
    with pytest.raises(OptionError, match="self_check"):
        restore(np.ones((80, 80), np.uint16), sensor=NAME, self_check=tmp_path / "map.tif")
