"""`Network`: an ONNX network and its origin, as the library passes it on."""

import hashlib
import io
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import onnx
import onnxruntime as ort

from beers_deploy.float_onnx import float_model, require_tile
from beers_deploy.model.exposure import brightened, factors_for
from beers_deploy.model.shipped import INT8, SENSOR, VARIANT, shipped_names
from beers_deploy.network_files import (
    Conditioned,
    conditioned,
    require_known,
    warn_outside,
)
from beers_deploy.profiles.errors import ModelError, optional, reason_of
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.profiles.shipped import BLIND, DEFAULT_TARGET
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.domains import OPSET
from beers_deploy.quant.encodings import CORE, board_model, read_core, vint8_model
from beers_deploy.quant.graph import require_one_image
from beers_deploy.quant.input_range import FROM_SAMPLES, KEY, Ranges, in_words
from beers_deploy.quant.onnx.external_weights import unchanged
from beers_deploy.quant.onnx_file import (
    faults_named,
    fixed_tile_px,
    is_quantized,
    load_onnx,
    metadata,
    read_onnx,
    save_onnx,
    with_one_output,
)
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from beers_deploy.quant.untrusted import times
from beers_deploy.results import Input, Table

if TYPE_CHECKING:
    import torch

    from beers_deploy.quant.quantize import Quantized


NetworkLike = Union["Network", onnx.ModelProto, "torch.nn.Module", str, os.PathLike[str]]


@dataclass(frozen=True, eq=False, repr=False)
class Network:
    """An ONNX network and its origin.

    `Network.load` accepts any kind of network.

    Attributes:
        model: the network.
        name: the stem of its file, or the name that it is shipped under.
        path: the file that holds it; None if it is only in memory.
        origin: the float network that it was quantised from, if that was done here.
        layers: if it was quantised here, a row for each replaced operator and each integer layer.
        quantised: its integer core and the graph that it was rounded from, if it was quantised here
            by itself.
        file_sha256: the SHA-256 of the file as it was read; empty if it is only in memory.
        weights: if it is conditioned on its sensor, the weights that it was made from.
        profile: the sensor that such a network is conditioned on.
        table: the report of `quantize`.

    Examples:
        >>> bd.Network.load("convbeers-s-int8").precision
        'int8'
    """

    model: onnx.ModelProto
    name: str
    path: Path | None = None
    origin: "Network | None" = None
    layers: tuple[Row, ...] = ()
    quantized: "Quantized | None" = None
    file_sha256: str = ""
    weights: Conditioned | None = None
    profile: Sensor | None = None
    table: "Table | None" = None

    @classmethod
    def load(
        cls,
        network: NetworkLike | None,
        *,
        sensor: SensorLike = BLIND,
        int8: bool | None = None,
        example: Sequence[int] = (1, 1, 64, 64),
        to_run: bool = True,
    ) -> "Network":
        """Load a network from an ONNX or safetensors file, a shipped name, a ModelProto or a torch
        module.

        Args:
            network: the network. A shipped name ends in -int8 for INT8. A `Network` is returned as
                it is. None is convbeers-s-int8.
            sensor: the sensor that a shipped network is conditioned on: a `Sensor`, a name or a
                .toml file.
            int8: the precision of a conditioned network; None leaves it to the name.
            example: shape (N, C, H, W) of an image that a torch module accepts; number and size
                stay free.
            to_run: True if a runtime may open the network; False if only the nodes of a file are
                inspected, whoever defines them.

        Raises:
            ModelError: there is no such network, or it is one that no runtime may open.
            MissingExtraError: `network` is a torch module, and torch is not installed to export it.
        """
        if isinstance(network, Network):
            return network
        if network is None:
            network = f"{VARIANT}{INT8}"
        if isinstance(network, onnx.ModelProto):
            name = network.graph.name or "network"
            return cls(read_onnx(network.SerializeToString(), name), name)
        if isinstance(network, str | os.PathLike):
            path = require_known(Path(network))
            weights = conditioned(path)
            if weights is not None:
                in_int8 = path.name.endswith(INT8) if int8 is None else int8
                profile = Sensor.load(sensor)
                warn_outside(profile, weights.kernels)
                return cls.for_sensor(weights, profile, int8=in_int8)
            to_run = to_run or path.suffix == ".safetensors"
            with unchanged(path) as digest:
                model = float_model(path) if to_run else load_onnx(path, to_run=False)
            return cls(model, path.stem, path, file_sha256=digest)
        return cls(exported(network, example), type(network).__name__)

    @classmethod
    def for_sensor(cls, weights: Conditioned, sensor: Sensor, *, int8: bool) -> "Network":
        """Build the network that sensor-conditioned weights give for one sensor.

        Args:
            weights: the sensor-conditioned weights.
            sensor: the sensor profile. If a value is a range, its middle is used.
            int8: True for the INT8 network, False for float32.

        Returns:
            The network for this sensor alone.

        Raises:
            ModelError: INT8 is requested, and the weights have no INT8 file.
        """
        name = f"{weights.name}{INT8}" if int8 else weights.name
        return cls(weights.model(sensor, int8), name, weights=weights, profile=sensor)

    def with_output(self, name: str | None) -> "Network":
        """Return the network with only one of its outputs.

        Args:
            name: the name of the output; None for the only one.

        Raises:
            ModelError: there are several outputs and no name, or several inputs.
            OptionError: there is no such output.
        """
        model = self.model if name is None else with_one_output(self.model, name, self.label)
        weights = {tensor.name for tensor in model.graph.initializer}
        inputs = [value.name for value in model.graph.input if value.name not in weights]
        with faults_named(self.label):
            require_one_image(inputs, [value.name for value in model.graph.output])
        return self if name is None else replace(self, model=model)

    @cached_property
    def exposures(self) -> Mapping[int, "Network"]:
        """The network conditioned on the sensor at higher gain, by the factor of the gain, which is
        above 1.

        Empty if the network is not conditioned on its sensor, or if the sensor's noise allows no
        factor.
        """
        if self.weights is None or self.profile is None:
            return {}
        int8 = self.precision == "int8"
        return {
            factor: Network.for_sensor(self.weights, brightened(self.profile, factor), int8=int8)
            for factor in factors_for(self.profile.nominal())
            if factor > 1
        }

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the network as an ONNX file, atomically."""
        save_onnx(self.model, Path(path))
        return Path(path)

    def core(
        self, board: TargetProfile | str = DEFAULT_TARGET, tile: int | None = None
    ) -> "Network":
        """Return the part of an INT8 network that the DPU or NPU computes, in the encoding that a
        board's tools read.

        Args:
            board: the board whose tools read the file. Those of an NPU read VINT8, of one tile.
            tile: side in pixels of the image that it is fixed to; the network's own, or any, if
                None.

        Raises:
            ModelError: the network is float, or INT8 that was not quantised under the DPU's rules
                here.
            OptionError: the board has an NPU and no tile is given, or the network cannot rearrange
                the tile.
        """
        core = read_core(self.model)
        side_px = tile or fixed_tile_px(self.model)
        require_tile(side_px, core.host_part.place_px)
        write = vint8_model if TargetProfile.load(board).npu else board_model
        return Network(write(core, metadata(self.model), side_px), f"{self.name}-core")

    def __call__(self, images: Any) -> np.ndarray:
        """Run the network on images (N, C, H, W), in its own units, and return (N, C', H', W')."""
        return result_of(self._session, np.ascontiguousarray(images, np.float32))

    @cached_property
    def _session(self) -> ort.InferenceSession:
        return open_session(self.model)

    @property
    def input_ranges(self) -> Ranges:
        """(low, high) of each channel that an INT8 network reads; empty if all are in [0, 1]."""
        if CORE not in metadata(self.model):
            return ()
        return read_core(self.model).host_part.input_ranges

    @property
    def stated_ranges(self) -> Ranges:
        """The ranges onto which 0 to full scale of an image is mapped; empty for [0, 1].

        Raises:
            ModelError: ranges of samples, which need not reach as far as full scale.
        """
        ranges = self.input_ranges
        if ranges and FROM_SAMPLES in metadata(self.model).get(KEY, FROM_SAMPLES):
            raise ModelError(
                f"{self.label} was quantised for the range of its samples, {in_words(ranges)}, so "
                "that it is not known which value is full scale. Quantise it again with "
                "`input_range`."
            )
        return ranges

    @property
    def precision(self) -> str:
        """The precision, "float32" or "int8"."""
        return "int8" if is_quantized(self.model) else "float32"

    @cached_property
    def tiling(self) -> Tiling:
        """The tiling geometry: halo, alignment, scale, bands in and out.

        Raises:
            ModelError: the network cannot be tiled.
        """
        return tiling_of(self.model, self.label)

    @property
    def sensor(self) -> str:
        """The name of the sensor that it is conditioned on or made for; empty if the file names
        none.
        """
        return metadata(self.model).get("sensor", "")

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the file that was read, or of the network's bytes if it is in memory alone."""
        return self.file_sha256 or hashlib.sha256(self.model.SerializeToString()).hexdigest()

    @property
    def input(self) -> Input:
        """The network as an input of results: its name and digest."""
        return Input(self.path.name if self.path else f"{self.name}.onnx", self.sha256)

    @property
    def label(self) -> str:
        """The name that messages use."""
        return str(self.path or self.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Network) and self.sha256 == other.sha256

    def __hash__(self) -> int:
        return hash(self.sha256)

    def __getstate__(self) -> dict[str, object]:
        # A session of onnxruntime cannot be pickled; the copy opens one of its own.
        return {key: value for key, value in vars(self).items() if key != "_session"}

    def __repr__(self) -> str:
        suffix = f", for {self.sensor}" if self.sensor else ""
        return (
            f"Network({self.name!r}: {self.precision}, {len(self.model.graph.node)} nodes{suffix})"
        )


def other_precision(network: Network) -> Network | None:
    """Return a shipped network of the same variant in the other precision, or None.

    Its weights may be others. Time depends only on the shapes, so the weights of any sensor will
    do.
    """
    variant = metadata(network.model).get("variant", "")
    if variant not in shipped_names():
        return None
    return Network.load(variant, sensor=SENSOR, int8=network.precision != "int8")


def exported(module: Any, example: Sequence[int]) -> onnx.ModelProto:
    """Export a torch module to ONNX, for any number and size of images."""
    if not hasattr(module, "state_dict"):
        raise ModelError(
            "`network` must be a Network, a ModelProto, a torch.nn.Module, a file or a shipped "
            f"name, got {type(module).__name__}."
        )
    torch = optional("torch", "network")
    free = {name: {0: "N", 2: "H", 3: "W"} for name in ("image", "restored")}
    stream = io.BytesIO()
    training = module.training
    with warnings.catch_warnings():
        # The exporter's own warnings do not count, because its file is checked below.
        warnings.simplefilter("ignore")
        try:
            names = {"input_names": ["image"], "output_names": ["restored"], "dynamic_axes": free}
            image = torch.zeros(tuple(example))
            torch.onnx.export(
                module.eval(), (image,), stream, opset_version=OPSET, dynamo=False, **names
            )
        # The code of a module may raise anything.
        except Exception as error:
            reason = reason_of(error)
            raise ModelError(
                f"torch cannot export the module {type(module).__name__}: {reason}. Check that it "
                f"accepts an image of {times(example)}, or give example=(N, C, H, W)."
            ) from error
        finally:
            # `eval` changed the caller's own module.
            module.train(training)
    return read_onnx(stream.getvalue(), type(module).__name__)
