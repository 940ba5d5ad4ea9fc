"""Tests of the inputs of a comparison of float and INT8, and of the samples that it judges."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import beers_deploy as bd
from beers_deploy.comparison import Data, sensor_input
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.samples.own import CALIBRATED_ON, digest_of
from tests.quant.quick import uniform


def test_a_sensor_of_the_same_name_and_other_numbers_is_another() -> None:
    sensor = Sensor.load("pleiades-degraded")
    other = sensor.replace(gain_dn_per_radiance=2 * sensor.gain_dn_per_radiance.low)
    assert sensor_input(sensor).name == sensor_input(other).name
    assert sensor_input(sensor).sha256 != sensor_input(other).sha256


@pytest.mark.parametrize("change", ["content", "name", "one more", "none"])
def test_a_folder_is_known_by_its_files(change: str, tmp_path: Path) -> None:
    folder = tmp_path / "ground"
    folder.mkdir()
    (folder / "a.tif").write_bytes(b"1")
    (folder / "b.tif").write_bytes(b"2")
    data = Data(Sensor.load("pleiades-degraded"), samples=None, images=folder, patches=1, seed=0)
    before = data.inputs
    # A file that is not read as a scene does not count.
    (folder / "gate.json").touch()
    if change == "content":
        (folder / "a.tif").write_bytes(b"3")
    elif change == "name":
        (folder / "a.tif").rename(folder / "c.tif")
    elif change == "one more":
        (folder / "c.tif").write_bytes(b"")
    assert (data.inputs == before) == (change == "none")


def test_the_judged_file_does_not_choose_its_samples(model: Path) -> None:
    """All samples are judged. Those that the file claims as its calibration are named in a note."""
    samples = uniform(12, 1, 32, 40)
    # An iterator can be read only once.
    int8 = bd.quantize(model, samples=iter(samples[:8]))
    mixed = np.concatenate([samples[10:], samples[2:7]])
    comparison = bd.compare(int8, samples=mixed)
    assert comparison.result.patches == 7
    # Quantising held two of its eight samples out of calibration, and one of them is here.
    assert "4 of 7 samples" in comparison.notes[0]
    model_with_claim = onnx.ModelProto()
    model_with_claim.CopyFrom(int8.model)
    claim = {CALIBRATED_ON: " ".join(map(digest_of, mixed[:, None]))}
    onnx.helper.set_model_props(model_with_claim, metadata(int8.model) | claim)
    second = bd.compare(replace(int8, model=model_with_claim), samples=mixed)
    assert (second.result.mae, second.result.patches) == (comparison.result.mae, 7)
    assert "7 of 7 samples" in second.notes[0]


@pytest.mark.parametrize(("name", "value"), [("patches", "1"), ("seed", "1"), ("metric", ["psnr"])])
def test_numbers_of_another_type_are_refused_in_a_sentence(name: str, value: Any) -> None:
    with pytest.raises(OptionError, match=f"`{name}` must be"):
        bd.compare("convbeers-xs", **{name: value})
