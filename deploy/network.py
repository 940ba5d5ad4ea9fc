"""Networks: a file of the user's, a module of torch, or a shipped one told a sensor.

`Network` is what the library hands on; the functions say which file a command means.

A shipped network is one set of weights, and one INT8 file, for every sensor in range. NAME is that network in float32
and NAME-int8 in INT8, each told one sensor: its filters, written in milliseconds from the profile alone. Where a file
is needed it lies in a folder of this process, which goes with it.
"""

import atexit
import hashlib
import io
import json
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import onnx
import onnxruntime as ort

from beers_deploy.export import float_for, float_model, require_tile
from beers_deploy.model.bank import network_bank
from beers_deploy.model.exposure import brightened, factors_for
from beers_deploy.model.family import sensor_vector
from beers_deploy.model.io.files import sha256
from beers_deploy.model.io.tensors import is_conditioned
from beers_deploy.model.progress import Log, no_log
from beers_deploy.model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_names, shipped_weights
from beers_deploy.profiles.errors import ModelError, OptionError, OutsideRangeWarning, optional
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor, numbers_of
from beers_deploy.profiles.sensor_file import BLIND, BLIND_PROFILE, load_sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, TargetProfile
from beers_deploy.profiles.toml import unreadable
from beers_deploy.quant.banked.family import required_family, with_delta
from beers_deploy.quant.encodings import board_model, host_model, read_core, vint8_model
from beers_deploy.quant.onnx_file import fixed_tile_px, is_quantised, load_onnx, metadata, read_onnx, save_onnx
from beers_deploy.quant.reading.external import network_sha256
from beers_deploy.quant.reading.folding import OPSET
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.tiling.walk import Tiling, tiling_of
from beers_deploy.quant.untrusted import times
from beers_deploy.results import Input

if TYPE_CHECKING:
    import torch

    from beers_deploy.quant.quantise import Quantised

NetworkLike = Union["Network", onnx.ModelProto, "torch.nn.Module", str, os.PathLike[str]]
SensorLike = Sensor | str | os.PathLike[str]


@dataclass(frozen=True, eq=False, repr=False)
class Network:
    """An ONNX network and where it comes from. `Network.load` makes one of whatever holds a network.

    Attributes:
        model: the network.
        name: the stem of its file, or the name that it is shipped under.
        path: the file that holds it; None of one that is in memory alone.
        origin: the float network that it was quantised from, where that was done here.
        layers: of a network that was quantised here, a row for each integer layer.
        quantised: its integers and the graph that they were rounded from, where it was quantised here by itself.

    Examples:
        >>> bd.Network.load("convbeers-s-int8").precision
        'int8'
    """

    model: onnx.ModelProto
    name: str
    path: Path | None = None
    origin: "Network | None" = None
    layers: tuple[Row, ...] = ()
    quantised: "Quantised | None" = None

    @classmethod
    def load(
        cls,
        network: NetworkLike,
        *,
        sensor: SensorLike = BLIND,
        example: Sequence[int] = (1, 1, 64, 64),
        to_run: bool = True,
    ) -> "Network":
        """A network from an ONNX or safetensors file, a shipped name, a ModelProto or a module of torch.

        Args:
            network: a shipped name has -int8 behind it for INT8; a `Network` is returned as it is.
            sensor: that a shipped network is told: a `Sensor`, a name or a .toml file.
            example: shape (N, C, H, W) of an image that a module of torch takes; number and size stay free.
            to_run: whether a runtime may get it; False where a file's nodes are only looked at, whosever they are.

        Raises:
            ModelError: no such network, or one that no runtime may get.
            MissingExtraError: a module of torch, and no torch to export it.
        """
        if isinstance(network, Network):
            return network
        if isinstance(network, onnx.ModelProto):
            name = network.graph.name or "network"
            return cls(read_onnx(network.SerializeToString(), name), name)
        if isinstance(network, str | os.PathLike):
            given = Path(network)
            path = network_file(given, Sensor.load(sensor), _warn)
            model = float_model(path) if to_run or path.suffix == ".safetensors" else load_onnx(path, to_run=False)
            return cls(model, given.stem if path == given else given.name, path)
        return cls(exported(network, example), type(network).__name__)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the network as an ONNX file, whole or not at all."""
        save_onnx(self.model, Path(path))
        return Path(path)

    def core(self, board: TargetProfile | str = DEFAULT_TARGET, tile: int | None = None) -> "Network":
        """The part of an INT8 network that the DPU or NPU computes, in the encoding that a board's tools read.

        Args:
            board: whose tools; those of an NPU read VINT8, of one tile.
            tile: side in pixels of the image that it is fixed to; the network's own, or any, if None.

        Raises:
            ModelError: a float network, or an INT8 one that was not quantised under the DPU's rules here.
            OptionError: an NPU and no tile, or one that the network cannot rearrange.
        """
        core, side_px = read_core(self.model), tile or fixed_tile_px(self.model)
        require_tile(side_px, core.ends.place_px)
        write = vint8_model if TargetProfile.load(board).npu else board_model
        return Network(write(core, metadata(self.model), side_px), f"{self.name}-core")

    def __call__(self, images: Any) -> np.ndarray:
        """What the network makes of images (N, C, H, W) in [0, 1]: (N, C', H', W') float32."""
        return result_of(self._session, np.ascontiguousarray(images, np.float32))

    @cached_property
    def _session(self) -> ort.InferenceSession:
        return open_session(self.model)

    @property
    def precision(self) -> str:
        """float32 or int8."""
        return "int8" if is_quantised(self.model) else "float32"

    @cached_property
    def tiling(self) -> Tiling:
        """How an image may be cut into tiles: halo, alignment, scale, bands in and out.

        Raises:
            ModelError: a network that cannot be tiled.
        """
        return tiling_of(self.model)

    @property
    def sensor(self) -> str:
        """The name of the sensor that it was told or made for; empty where the file names none."""
        return metadata(self.model).get("sensor", "")

    @cached_property
    def sha256(self) -> str:
        """Of its file, or of its bytes where it is in memory alone."""
        return network_sha256(self.path) if self.path else hashlib.sha256(self.model.SerializeToString()).hexdigest()

    @property
    def input(self) -> Input:
        """What results say of it."""
        return Input(self.path.name if self.path else f"{self.name}.onnx", self.sha256)

    @property
    def label(self) -> str:
        """What messages call it."""
        return str(self.path or self.name)

    @property
    def file(self) -> Path:
        """A file that holds it: its own, or one that goes with this process."""
        if self.path is not None:
            return self.path
        path = _place(self.name, self.sha256)
        return path if path.is_file() else self.save(path)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Network) and self.sha256 == other.sha256

    def __hash__(self) -> int:
        return hash(self.sha256)

    def __getstate__(self) -> dict[str, object]:
        return {key: value for key, value in vars(self).items() if key != "_session"}

    def __repr__(self) -> str:
        told = f", for {self.sensor}" if self.sensor else ""
        return f"Network({self.name!r}: {self.precision}, {len(self.model.graph.node)} nodes{told})"


def exported(module: Any, example: Sequence[int]) -> onnx.ModelProto:
    """A module of torch as ONNX, for any number and size of images."""
    if not hasattr(module, "state_dict"):
        expected = "a Network, a ModelProto, a torch.nn.Module, a file or a shipped name"
        remedy = "give one of these"
        raise ModelError("network", expected=expected, got=type(module).__name__, remedy=remedy)
    torch = optional("torch", "network")
    free = {name: {0: "N", 2: "H", 3: "W"} for name in ("image", "restored")}
    stream, training = io.BytesIO(), module.training
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own: what it writes is checked below
        try:
            names = {"input_names": ["image"], "output_names": ["restored"], "dynamic_axes": free}
            image = torch.zeros(tuple(example))
            torch.onnx.export(module.eval(), (image,), stream, opset_version=OPSET, dynamo=False, **names)
        except Exception as error:  # whatever a module's own code raises
            got = " ".join(str(error).split())[:160]
            remedy = f"check that it takes an image {times(example)}, or give example=(N, C, H, W)"
            expected = "a module that torch exports"
            raise ModelError(type(module).__name__, expected=expected, got=got, remedy=remedy) from error
        finally:
            module.train(training)
    return read_onnx(stream.getvalue(), type(module).__name__)


@dataclass(frozen=True)
class Conditioned:
    """Weights of a network that is told its sensor, and the name that it is listed under."""

    name: str
    weights: Path

    def model(self, sensor: Sensor, int8: bool) -> onnx.ModelProto:
        """The network told a sensor, in float32 or in INT8."""
        if not int8:
            return float_for(self.weights, self.name, sensor)
        shipped = SHIPPED / f"{self.name}{INT8}.onnx"
        if self.weights.parent != SHIPPED:
            remedy = f"make one for every sensor: beers-deploy quantize {self.weights} --out {self.name}{INT8}.onnx"
            raise ModelError(str(self.weights), expected="an INT8 network", got="float weights", remedy=remedy)
        return told_int8(load_onnx(shipped), sensor)


def conditioned(given: Path | None) -> Conditioned | None:
    """The network to be told its sensor that is meant, None meaning the default one; None for any other file."""
    if given is None:
        return Conditioned(VARIANT, shipped_weights(VARIANT))
    if _is_shipped(given):
        name = given.name.removesuffix(INT8)
        return Conditioned(name, shipped_weights(name))
    return Conditioned(given.stem, given) if given.suffix == ".safetensors" and is_conditioned(given) else None


def weights_file(given: Path) -> Path:
    """The file given, or the shipped one of that name where no such file lies; nothing is read."""
    if not _is_shipped(given):
        return given
    return SHIPPED / f"{given.name}.onnx" if given.name.endswith(INT8) else shipped_weights(given.name)


def _is_shipped(given: Path) -> bool:
    """Whether a shipped network is meant by its name, with INT8 behind it or without."""
    named = given == Path(given.name) and given.name.removesuffix(INT8) in shipped_names()
    return named and not given.exists()


def in_int8(given: Path) -> Path:
    """A shipped network's name with INT8 behind it; any other path as it is."""
    return Path(given.name.removesuffix(INT8) + INT8) if _is_shipped(given) else given


def pair_of(floating: Path | None, int8: Path | None) -> tuple[Path, Path]:
    """A float network and its INT8: the files given, or a shipped pair by its name, the default one if None."""
    name = Path(VARIANT) if floating is None else floating
    if int8 is None and not name.suffix and not name.exists():
        shipped_weights(name.name)
    elif int8 is None:
        remedy = "give its INT8 file too, or the name of a shipped pair"
        raise OptionError("INT8", expected=f"the INT8 network of {name.name}", got="none", remedy=remedy)
    return name, in_int8(int8 or name)


def network_file(given: Path | None, sensor: Sensor, log: Log = no_log) -> Path:
    """The file of a network: the one given, or a conditioned network's for the sensor, INT8 where its name says so.

    Args:
        given: a file, or a shipped name where no such file lies; None is the default network in INT8.
        sensor: what a conditioned network is told: the middle of each of its ranges.
        log: is told what of the sensor lies outside the range that was trained.
    """
    if given is not None and not (given.suffix or given.exists() or _is_shipped(given)):
        expected = f"a file, or a shipped network ({', '.join(shipped_names())}, each also with {INT8})"
        raise ModelError(str(given), expected=expected, got="neither", remedy="correct the name, or the path")
    int8 = given is None or given.name.endswith(INT8)
    return int8_file(given, sensor, log) if int8 else float_file(given, sensor, log)


def brighter_files(given: Path | None, sensor: Sensor) -> dict[int, Path]:
    """Write a conditioned network for the sensor at higher exposures; return the files by factor.

    Args:
        given: as of `network_file`.
        sensor: likewise.

    Returns:
        Empty for any other network, and where the sensor's noise allows no factor above 1.
    """
    network = conditioned(given)
    if network is None:
        return {}
    int8 = given is None or given.name.endswith(INT8)
    factors = factors_for(sensor.nominal())
    return {factor: _written(network, brightened(sensor, factor), int8, no_log) for factor in factors if factor > 1}


def float_file(given: Path | None, sensor: Sensor, log: Log = no_log) -> Path:
    """As `network_file`, a conditioned network always in float32."""
    found = conditioned(given)
    return _written(found, sensor, False, log) if found else given or Path()


def int8_file(given: Path | None, sensor: Sensor, log: Log = no_log) -> Path:
    """As `network_file`, a conditioned network always in INT8."""
    found = conditioned(given)
    return _written(found, sensor, True, log) if found else given or Path()


def shipped_pair(name: str = VARIANT, sensor: str = SENSOR) -> tuple[Path, Path]:
    """A shipped network in float32 and in INT8, told a sensor."""
    known, given = load_sensor(sensor), Path(shipped_weights(name).stem)
    return float_file(given, known), int8_file(given, known)


def warn_outside(sensor: Sensor, log: Log) -> None:
    """Tell what of a sensor lies outside the range that was trained."""
    for sentence in sensor_vector(sensor.nominal()).outside:
        log(f"warning: {sentence}")


def other_sensor(model: onnx.ModelProto, sensor: Sensor) -> str:
    """Return a warning if a network was made for another sensor than the one named; else nothing."""
    own = metadata(model).get("sensor", "")
    if own in ("", BLIND, BLIND_PROFILE, sensor.name):
        return ""
    return f"look at the sensor: the network was made for {own}, not for {sensor.name}"


def other_precision(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """A shipped network of the same variant in the other precision, or None; its weights may be others.

    Time depends on the shapes, not on the weights: for a comparison of time any weights will do.
    """
    variant = metadata(model).get("variant", "")
    if variant not in shipped_names():
        return None
    find = float_file if is_quantised(model) else int8_file
    return load_onnx(find(Path(variant), load_sensor(SENSOR)))


def _warn(sentence: str) -> None:
    warnings.warn(sentence, OutsideRangeWarning, stacklevel=4)


@cache
def _folder() -> Path:
    """Where the files of this process lie, until it ends."""
    folder = TemporaryDirectory(prefix="beers-deploy-", ignore_cleanup_errors=True)
    atexit.register(folder.cleanup)
    return Path(folder.name)


def _written(network: Conditioned, sensor: Sensor, int8: bool, log: Log) -> Path:
    warn_outside(sensor, log)
    stem = network.name + (INT8 if int8 else "")
    told = json.dumps({"weights": sha256(network.weights), "sensor": numbers_of(sensor)}, sort_keys=True, default=str)
    path = _place(stem, hashlib.sha256(told.encode()).hexdigest())
    if not path.is_file():
        save_onnx(network.model(sensor, int8), path)
    return path


def _place(name: str, digest: str) -> Path:
    """Of a file of this process, named for the tables that show it."""
    folder, stem = _folder() / digest[:12], re.sub(r"[^\w.-]+", "-", name)[:40]
    folder.mkdir(exist_ok=True)
    return folder / f"{stem}.onnx"


def told_int8(
    model: onnx.ModelProto, sensor: Sensor, more: Mapping[str, str] | None = None, log: Log = no_log
) -> onnx.ModelProto:
    """An INT8 network behind a bank told another sensor: its filters, unit and biases written anew.

    Args:
        model: of whatever sensor.
        sensor: of which the middle is taken.
        more: metadata to add.
        log: is told what of the sensor lies outside the range that was trained.
    """
    warn_outside(sensor, log)
    known = sensor.nominal()
    core = required_family(model).for_sensor(network_bank(known), sensor_vector(known).values)
    return host_model(core, {**metadata(model), "sensor": sensor.name, **(more or {})}, fixed_tile_px(model))


def told_by_delta(model: onnx.ModelProto, delta: Path) -> onnx.ModelProto:
    """An INT8 network behind a bank told the sensor of a delta, a file that `export --delta` wrote."""
    try:
        packed = delta.read_bytes()
    except OSError as error:
        got, remedy = unreadable(delta) or str(error), "give a file that 'export --delta' wrote"
        raise ModelError(str(delta), expected="a delta", got=got, remedy=remedy) from error
    core, name = with_delta(required_family(model).core, packed)
    return host_model(core, {**metadata(model), "sensor": name}, fixed_tile_px(model))
