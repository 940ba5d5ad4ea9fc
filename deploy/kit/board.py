"""A board, and the kit for its engineer."""

import json
import logging
import os
import shutil
from pathlib import Path

import numpy as np

from beers_deploy.conditioned_file import to_run_on
from beers_deploy.dpu.board import device_of
from beers_deploy.dpu.checker.table import check_network
from beers_deploy.kit import RECORD
from beers_deploy.kit.golden import PICTURE, save_array, write_golden
from beers_deploy.kit.host_facts import host_facts
from beers_deploy.kit.record import require_library, write_record
from beers_deploy.model.consistency.step import REACH_PX
from beers_deploy.model.exposure import HEADROOM, SHARPEST, SHARPEST_IN_DARK
from beers_deploy.model.io.files import require_writable, write_text
from beers_deploy.network import Network, NetworkLike
from beers_deploy.network_files import other_sensor
from beers_deploy.profiles.errors import OptionError, as_path
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.profiles.shipped import BLIND, TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.encodings import save_config
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.session import open_session, tensors_of
from beers_deploy.tables.markup import markdown_text

logger = logging.getLogger(__name__)

MEASURE, HOST, README = (
    Path(__file__).parent / name for name in ("measure.py", "host.py", "readme.md")
)


class Board(TargetProfile):
    """A processing board with a DPU or NPU, as its profile describes it.

    The profile is a TOML file with the configurations (builds) of the accelerator, the limits of
    its operator rules, and the constants of the cost model, each with its source. `Board.load`
    reads a shipped one by its name, or a user's file.

    Examples:
        >>> bd.Board.load("zcu104").default_configuration
        'B4096'
    """

    def kit(
        self,
        int8: NetworkLike,
        out: str | os.PathLike[str],
        *,
        tile: int | None = None,
        record: bool = False,
        sensor: SensorLike | None = None,
    ) -> Path:
        """Write a folder with all that an engineer needs to run an INT8 network on this board.

        `core.onnx` is the integer core: the part that the DPU computes, fixed to a tile.
        `measure.py` times it on the board and writes `board.json`, which `bench` accepts as
        `measured`. `input.npy` and `expected.npy` are one input of the core and its result from
        onnxruntime on this processor. `host.py` is the host part, the steps before and after the
        core, in plain NumPy. `golden` contains the expected output of every layer. README.md
        explains what to do on the board.

        With a sensor, `host.py` takes the same steps around the network as `restore`. The
        consistency step makes block means of the result agree with the raw image. With exposures,
        which only a shipped network has, dark pixels are multiplied by a factor before the network
        and divided afterwards; the cores of the factors are `core-x4.onnx` and so on. The golden
        vectors are those of `core.onnx`.

        Args:
            int8: the network, quantised under this board's rules.
            out: the folder to write.
            tile: side of a tile in pixels, the only image size that the cores accept. None stands
                for the size that the network is fixed to, or for 640.
            record: True to add a record of evidence: what the network is, and the result of
                `check`.
            sensor: the sensor that acquires the images: a `Sensor`, a name or a .toml file. A
                shipped network is conditioned on it. None stands for the middle of the sensors that
                the network supports, and omits the steps around the network.

        Returns:
            The path of the folder.

        Raises:
            MissingExtraError: a record is requested, and cyclonedx-python-lib is not installed.
            ModelError: the network is float, damaged, or was not quantised under a DPU's rules
                here.
            MachineError: `out` is not a folder.
            OptionError: the sensor would change nothing, `tile` is not a side of 16 to 8192 pixels
                that leaves room between two halos of the network, or the board has neither a DPU
                nor an NPU.
            ProfileError: there is no such sensor.
        """
        device_of(self)
        folder = as_path(out)
        require_writable(folders=[folder])
        profile = None if sensor is None else Sensor.load(sensor)
        images_of = profile or Sensor.load(BLIND)
        network = to_run_on(Network.load(int8, sensor=images_of), images_of)
        tile = _tile_px(tile, network)
        warning = other_sensor(network.model, images_of)
        if warning:
            logger.warning(warning)
        # A missing library is refused before anything is written.
        if record:
            require_library()
        exposed = {} if profile is None else network.exposures
        facts = host_facts(network, tile, profile, exposed)
        core = network.core(self, tile)
        # Files of an earlier kit in this folder would describe other cores.
        records = [folder / "record" / name for name in RECORD]
        others = [folder / name for name in ("known.json", "host.json", "host.py")]
        for older in (*folder.glob("core-x*.onnx"), *others, *records):
            older.unlink(missing_ok=True)
        core.save(folder / "core.onnx")
        for factor, other in exposed.items():
            other.core(self, tile).save(folder / f"core-x{factor:g}.onnx")
        # The compiler of an NPU reads its configuration next to the core.
        if self.npu:
            save_config(folder / "core.onnx", *self.npu["device"].value)
        _write_example(core, folder)
        shutil.copyfile(MEASURE, folder / "measure.py")
        if facts is not None:
            write_text(folder / "host.json", json.dumps(facts, indent=1) + "\n")
            shutil.copyfile(HOST, folder / "host.py")
        vectors = write_golden(network, folder / "golden", target=self)
        # The golden vectors have tiles of their own side, and so need a core of that side.
        vectors_px = np.load(vectors / "noise" / PICTURE).shape[-1]
        network.core(self, vectors_px).save(vectors / "core.onnx")
        if record:
            checked = check_network(network, self, None, tile)
            write_record(checked, network, images_of, folder / "record")
        words = {
            "network": markdown_text(network.name),
            "board": markdown_text(self.name),
            "configuration": markdown_text(self.default_configuration or "NAME"),
            "tile": tile,
            "reach": REACH_PX,
            "headroom": HEADROOM,
            "sharpest": SHARPEST,
            "sharpest_in_dark": SHARPEST_IN_DARK,
        }
        write_text(folder / "README.md", README.read_text(encoding="utf-8").format(**words))
        return folder


def _tile_px(tile: int | None, network: Network) -> int:
    """Return the side of a tile, or raise OptionError if a core cannot have it."""
    if tile is None:
        tile = fixed_tile_px(network.model) or TILE_PX
    if not isinstance(tile, int | np.integer) or not 16 <= tile <= 8192:
        raise OptionError(
            f"`tile` must be a whole number of 16 to 8192 px, got {tile!r}. Choose another."
        )
    return int(tile)


def _write_example(core: Network, folder: Path) -> None:
    """Write one input of a core, and the result of onnxruntime for it on this processor."""
    session = open_session(core.model)
    (tensor,) = session.get_inputs()
    shape = [side if isinstance(side, int) else 1 for side in tensor.shape]
    kind = np.int8 if "int8" in tensor.type else np.float32
    planes = np.random.default_rng(0).integers(-64, 64, shape).astype(kind)
    save_array(folder / "input.npy", planes)
    save_array(folder / "expected.npy", tensors_of(session, None, planes)[0])
