"""Tests that the checksum of an INT8 file finds every later change of its integers."""

from copy import deepcopy
from pathlib import Path

import numpy as np
import onnx
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from onnx import numpy_helper

import beers_deploy as bd
from beers_deploy.model.shipped import INT8, SENSOR, SHIPPED, shipped_names
from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.encodings import CHECKSUM, CORE, SENSOR_BIASES, require_undamaged
from beers_deploy.quant.onnx_file import load_onnx, metadata, save_onnx
from tests.deploy.command_line import done, refused
from tests.deploy.restoration.runs import noise

NAME = f"convbeers-xs{INT8}"
STORED = load_onnx(SHIPPED / f"{NAME}.onnx")
MESSAGE = "is damaged: its integers are not those of its checksum"


def flipped(model: onnx.ModelProto, number: int, bit: int) -> onnx.ModelProto:
    """Return a copy of a model with one bit of one of its constants flipped."""
    copy = deepcopy(model)
    tensor = copy.graph.initializer[number % len(copy.graph.initializer)]
    values = numpy_helper.to_array(tensor)
    content = bytearray(values.tobytes())
    content[bit // 8 % len(content)] ^= 1 << bit % 8
    tensor.CopyFrom(
        numpy_helper.from_array(
            np.frombuffer(bytes(content), values.dtype).reshape(values.shape), tensor.name
        )
    )
    return copy


@given(st.integers(0, 200), st.integers(0, 1 << 20))
def test_every_flip_of_a_constant_is_found(number: int, bit: int) -> None:
    """It covers weights, biases and scales, and each of their bits."""
    with pytest.raises(ModelError, match=MESSAGE):
        require_undamaged(flipped(STORED, number, bit), "a.onnx")


@pytest.mark.parametrize("key", [CORE, SENSOR_BIASES])
def test_the_text_from_which_integers_are_computed_is_covered_too(key: str) -> None:
    """A changed digit in the metadata changes the network of each sensor."""
    copy = deepcopy(STORED)
    text = metadata(copy)[key]
    onnx.helper.set_model_props(copy, {**metadata(copy), key: text.replace("1", "2", 1)})
    with pytest.raises(ModelError, match=MESSAGE):
        require_undamaged(copy, "a.onnx")


def test_files_as_written_pass() -> None:
    """Shipped files, a sensor's network, one with a later entry and one without checksum pass."""
    for name in shipped_names():
        require_undamaged(load_onnx(SHIPPED / f"{name}{INT8}.onnx"), name)
    require_undamaged(Network.load(NAME, sensor=SENSOR).model, NAME)
    more = deepcopy(STORED)
    onnx.helper.set_model_props(more, {**metadata(more), "mission": "mine"})
    require_undamaged(more, "more")
    without = flipped(STORED, 3, 5)
    about = {key: text for key, text in metadata(without).items() if key != CHECKSUM}
    onnx.helper.set_model_props(without, about)
    require_undamaged(without, "of another program")


@pytest.mark.parametrize("sensor", ["", SENSOR])
def test_a_damaged_file_restores_nothing(sensor: str, tmp_path: Path) -> None:
    """It is refused as it is stored, and conditioned on a sensor, whose file has a new checksum.

    No kit is made from it, and no gate passes it.
    """
    stored = Network.load(NAME, sensor=sensor).model if sensor else STORED
    path = tmp_path / "damaged.onnx"
    # No sensor replaces this layer.
    names = [tensor.name for tensor in stored.graph.initializer]
    save_onnx(flipped(stored, names.index("body.0.first.weight"), 0), path)
    image = tmp_path / "image.tif"
    tifffile.imwrite(image, noise(64, 96))
    out = tmp_path / "out.tif"
    assert MESSAGE in refused("restore", image, out, "--network", path, "--sensor", SENSOR)
    with pytest.raises(ModelError, match=MESSAGE):
        bd.Board.load("vck190").kit(path, tmp_path / "kit", tile=64, sensor=SENSOR)
    assert MESSAGE in refused("golden", path, "--out", tmp_path / "golden")
    assert MESSAGE in refused("export --tile 64 --network", path, "--out", tmp_path / "out.onnx")
    assert {*tmp_path.iterdir()} == {path, image}
    gate = f"gate convbeers-xs {path} --patches 1"
    assert "the checksum of the integers" in done(gate, code=1)
