"""Boards for notebooks, what a board's engineer is handed, and tables of what is shipped."""

import os
import shutil
from pathlib import Path

import numpy as np

from beers_deploy.model.io.files import whole_file
from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.figures import Figure, Mode, Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import sensor_names
from beers_deploy.profiles.target import TargetProfile, board_names
from beers_deploy.quant.encodings import board_model, read_core
from beers_deploy.quant.onnx_file import metadata, save_onnx
from beers_deploy.quant.session import open_session, tensors_of
from beers_deploy.results import Table

TILE_PX = 640
MEASURE = Path(__file__).with_name("board_measure.py")


class Board(TargetProfile):
    """A processing board: its DPU's configurations, rules and cost constants, each with its source."""

    def kit(self, int8: NetworkLike, out: str | os.PathLike[str], *, tile: int = TILE_PX) -> Path:
        """Write what a board's engineer needs of an INT8 network to a folder, and return it.

        `core.onnx` is the part that the DPU computes, fixed to a tile. `measure.py` times it there and writes
        `board.json`, which `predict` takes as `measured`. `input.npy` and `expected.npy` are one input of the core
        and what onnxruntime makes of it on this processor.

        Args:
            int8: the network, quantised under this board's rules.
            out: the folder.
            tile: side of a tile in pixels.

        Raises:
            ModelError: a float network, or one that was not quantised under a DPU's rules here.
        """
        network, folder = Network.load(int8), Path(out)
        core = board_model(read_core(network.model), metadata(network.model), tile)
        save_onnx(core, folder / "core.onnx")
        session = open_session(core)
        shape = [side if isinstance(side, int) else 1 for side in session.get_inputs()[0].shape]
        planes = np.random.default_rng(0).integers(-64, 64, shape).astype(_dtype(session.get_inputs()[0].type))
        for name, values in (("input", planes), ("expected", tensors_of(session, None, planes)[0])):
            with whole_file(folder / f"{name}.npy") as temporary, temporary.open("wb") as stream:
                np.save(stream, values)
        shutil.copyfile(MEASURE, folder / "measure.py")
        return folder


def _dtype(name: str) -> type[np.generic]:
    return np.int8 if "int8" in name else np.float32


def boards() -> Table:
    """The shipped boards with a DPU: its configurations, and where its rules come from."""
    rows = []
    for name in board_names():
        board = Board.load(name)
        words = {"configurations": ", ".join(board.configurations), "description": board.description}
        rows.append(Row("boards", name, {}, words))
    return Table("boards", {}, (), tuple(rows))


def sensors() -> Table:
    """The shipped sensors: contrast at Nyquist, SNR, bits, and what each is."""
    return Table("sensors", {}, (), tuple(map(_sensor_row, map(Sensor.load, sensor_names()))))


def _sensor_row(sensor: Sensor) -> Row:
    stated = {
        "MTF at Nyquist": (sensor.mtf_nyquist, "ratio"),
        "SNR": (sensor.snr_1, "ratio"),
        "bits": (sensor.bits, "bit"),
    }
    figures = {key: _figure(constant, unit) for key, (constant, unit) in stated.items() if constant is not None}
    return Row("sensors", sensor.name, figures, {"description": sensor.description})


def _figure(constant: Constant, unit: str) -> Figure:
    """A constant as a figure: a range is the interval about its middle."""
    interval = None if constant.low == constant.high else (constant.low, constant.high)
    mode: Mode = "measured" if constant.status == "measured" else "published"
    return Figure((constant.low + constant.high) / 2, unit, mode, f"{constant.status}: {constant.source}", interval)


def networks() -> Table:
    """The shipped networks, each in float32 and in INT8, told the middle of the sensors that they know."""
    names = [each for name in shipped_names() for each in (name, f"{name}{INT8}")]
    rows = [Row("networks", each.name, {}, {"precision": each.precision}) for each in map(Network.load, names)]
    return Table("networks", {}, (), tuple(rows))
