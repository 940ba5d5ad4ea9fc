"""`Network`: an ONNX network and its origin, as the library passes it on."""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import onnx
import onnxruntime as ort

from beers_deploy.float_onnx import exported, float_model, require_tile
from beers_deploy.model.exposure import UNCHANGED, Exposure, exposures_for
from beers_deploy.model.shipped import INT8, SENSOR, VARIANT, shipped_names
from beers_deploy.network_files import (
    Conditioned,
    ConditionedFile,
    conditioned,
    require_known,
    warn_outside,
)
from beers_deploy.profiles.errors import ModelError, as_path, require_numbers
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.profiles.shipped import BLIND, DEFAULT_TARGET
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.encodings import CORE, board_model, read_core, vint8_model
from beers_deploy.quant.graph import require_one_image
from beers_deploy.quant.input_range import FROM_SAMPLES, KEY, Ranges, in_words
from beers_deploy.quant.onnx.external_weights import unchanged
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import (
    faults_named,
    is_quantized,
    load_onnx,
    metadata,
    read_onnx,
    save_onnx,
    with_one_output,
)
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.tiling.receptive_field import Tiling, independent_tiles, tiling_of
from beers_deploy.results import Input, Table

if TYPE_CHECKING:
    import torch

    from beers_deploy.quant.quantize import Quantized


NetworkLike = Union["Network", onnx.ModelProto, "torch.nn.Module", str, os.PathLike[str]]


@dataclass(frozen=True, eq=False, repr=False)
class Network:
    """One ONNX network for image restoration, in float32 or INT8, and its origin.

    `Network.load` makes one from a file, a shipped name, an ONNX model or a torch module. Call the
    instance to run it on images. The filters of a sensor-conditioned network are computed from the
    blur and noise of one sensor. "In this process" below means that `quantize` was called in the
    same Python process, in contrast to a network that was read from a file.

    Attributes:
        model: the ONNX model.
        name: the stem of the network's file, the name that it is shipped under, or the name of its
            ONNX graph or torch class.
        path: the file that the network was read from; None if the network was computed for a sensor
            or is only in memory.
        origin: the float network that this INT8 network was quantised from in this process, or
            None.
        layers: one row for each replaced operator and each integer layer, if the network was
            quantised in this process; otherwise empty.
        quantized: the integers and the float graph that they were rounded from, if the network was
            quantised in this process and is not sensor-conditioned; otherwise None.
        file_sha256: the SHA-256 of the file's bytes; empty if the network was not read from a file.
        weights: the weights that a sensor-conditioned network was computed from; None for another.
        profile: the sensor that a sensor-conditioned network is for; None for another.
        table: the report of `quantize`; None if the network does not come from `quantize`.

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
    weights: Conditioned | ConditionedFile | None = None
    profile: Sensor | None = None
    table: "Table | None" = None

    @classmethod
    def load(
        cls,
        network: NetworkLike | None,
        *,
        sensor: SensorLike = BLIND,
        int8: bool | None = None,
        example: "Sequence[int] | torch.Tensor" = (1, 1, 64, 64),
        to_run: bool = True,
    ) -> "Network":
        """Load a network from an ONNX or safetensors file, a shipped name, a ModelProto or a torch
        module.

        Args:
            network: the network. A shipped name ends in -int8 for INT8. A `Network` is returned
                unchanged. None stands for the shipped convbeers-s-int8.
            sensor: the sensor whose images are to be restored: a `Sensor`, a name or a .toml file.
                Only shipped networks and weights of `train --conditioned` read it, because
                their filters are computed from it. By default the sensor is unknown.
            int8: True for INT8 and False for float32 in a network that `sensor` conditions; None
                to decide by the suffix -int8 of its name. Other networks ignore it.
            example: an input (N, C, H, W) that a torch module accepts, or its shape. The exported
                network accepts any N, H and W.
            to_run: True if onnxruntime will run the network; False to inspect only the nodes of an
                .onnx file, which may then be operators that onnxruntime does not know.

        Raises:
            ModelError: no file or shipped network has this name, the file is not a valid network,
                `network` is of an unsupported type, or torch cannot export the module.
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
    def for_sensor(
        cls,
        weights: Conditioned | ConditionedFile,
        sensor: Sensor,
        *,
        int8: bool,
        exposure: Exposure = UNCHANGED,
    ) -> "Network":
        """Compute the network of one sensor from weights that serve every sensor.

        Args:
            weights: sensor-conditioned weights or their INT8 file. The first filters are computed
                from the sensor's blur and noise.
            sensor: the sensor profile. If a value is a range, its middle is used.
            int8: True for the INT8 network, False for float32.
            exposure: the factor by which pixels are multiplied before the network.

        Returns:
            The network, whose filters suit this sensor only.

        Raises:
            ModelError: INT8 is requested for weights that are not shipped, so that there is no INT8
                file.
        """
        name = f"{weights.name}{INT8}" if int8 else weights.name
        return cls(weights.model(sensor, int8, exposure), name, weights=weights, profile=sensor)

    def with_output(self, name: str | None) -> "Network":
        """Return the network reduced to one of its outputs.

        Args:
            name: the name of the output to retain; None if the network has only one.

        Returns:
            A copy with this output; the network itself if `name` is None.

        Raises:
            ModelError: the network has several outputs and `name` is None, or it has several
                inputs.
            OptionError: the network has no output of this name.
        """
        model = self.model if name is None else with_one_output(self.model, name, self.label)
        weights = {tensor.name for tensor in model.graph.initializer}
        inputs = [value.name for value in model.graph.input if value.name not in weights]
        with faults_named(self.label):
            require_one_image(inputs, [value.name for value in model.graph.output])
        return self if name is None else replace(self, model=model)

    @cached_property
    def exposures(self) -> Mapping[float, "Network"]:
        """The networks for dark pixels and strong edges by exposure factor; none without a sensor.

        `restore` multiplies such pixels, runs the network of the factor, and divides the result.
        """
        if self.weights is None or self.profile is None:
            return {}
        int8 = self.precision == "int8"
        exposed = partial(Network.for_sensor, self.weights, self.profile, int8=int8)
        every = exposures_for(self.profile.nominal(), int8=int8)
        return {each.factor: exposed(exposure=each) for each in every if each != UNCHANGED}

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the network as an ONNX file, atomically, and return the path of the file."""
        file = as_path(path)
        save_onnx(self.model, file)
        return file

    def core(
        self, board: TargetProfile | str = DEFAULT_TARGET, tile: int | None = None
    ) -> "Network":
        """Return the integer core of an INT8 network, in the encoding that a board's tools read.

        The core is the part that the DPU or NPU computes. The steps before and after it, such as
        the encoding of pixels as int8, stay on the board's processor.

        Args:
            board: the board whose tools read the file: QDQ ONNX for a DPU, VINT8 for an NPU.
            tile: side in pixels of the only tile size that the core accepts. None retains the size
                that the network is fixed to, or any size if it is not fixed to one.

        Returns:
            A network in memory that reads and writes the core's tensors instead of images.

        Raises:
            ModelError: the network is float, or was not made by `quantize`.
            OptionError: the board has an NPU and the tile size is not fixed, or the tile is not a
                multiple of the squares of pixels that the network moves into channels.
        """
        core = read_core(self.model)
        side_px = fixed_tile_px(self.model) if tile is None else tile
        side_px = require_tile(side_px, core.host_part.place_px)
        write = vint8_model if TargetProfile.load(board).npu else board_model
        return Network(write(core, metadata(self.model), side_px), f"{self.name}-core")

    def __call__(self, images: Any) -> np.ndarray:
        """Run the network in onnxruntime on images (N, C, H, W) and return (N, C', H', W').

        Values are float32 in the range that the network was trained on: [0, 1] of full scale for
        the shipped networks.
        """
        require_numbers("images", images)
        return result_of(self._session, np.ascontiguousarray(images, np.float32))

    @cached_property
    def _session(self) -> ort.InferenceSession:
        return open_session(self.model)

    @property
    def input_ranges(self) -> Ranges:
        """The (low, high) of the values in each input channel, for which INT8 was calibrated.

        The tuple is empty if all channels are in [0, 1], and for a network that `quantize` did not
        make.
        """
        if CORE not in metadata(self.model):
            return ()
        return read_core(self.model).host_part.input_ranges

    @property
    def stated_ranges(self) -> Ranges:
        """The (low, high) of each input channel onto which pixels from 0 to full scale are mapped.

        The tuple is empty if the network reads pixels as [0, 1] of full scale.

        Raises:
            ModelError: the ranges were found in the calibration samples rather than stated by the
                user. Samples need not reach full scale, so the mapping is unknown.
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
        """The geometry by which large images are cut into tiles for this network.

        It states the halo (context pixels around a tile, later discarded), the multiple of pixels
        on which tiles begin, the enlargement, and the numbers of bands read and returned.

        Raises:
            ModelError: the network cannot be tiled, for example because an operator reads the whole
                image.
        """
        return tiling_of(self.model, self.label)

    @cached_property
    def geometry(self) -> Tiling:
        """The tiling, or that of independent tiles for a network of fixed size that reads its whole
        tile.

        Raises:
            ModelError: the network cannot be applied to tiles.
        """
        try:
            return self.tiling
        except ModelError as error:
            return independent_tiles(self.model, error)

    @property
    def sensor(self) -> str:
        """The name of the network's sensor in the file's metadata; empty if the file names none."""
        return metadata(self.model).get("sensor", "")

    @cached_property
    def sha256(self) -> str:
        """SHA-256 in hexadecimal of the file that was read, or of the ONNX model without a file."""
        return self.file_sha256 or hashlib.sha256(self.model.SerializeToString()).hexdigest()

    @property
    def input(self) -> Input:
        """The file name and SHA-256 by which a results document lists the network."""
        return Input(self.path.name if self.path else f"{self.name}.onnx", self.sha256)

    @property
    def label(self) -> str:
        """The name of the network in messages: its path, or its name if there is no file."""
        return str(self.path or self.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Network) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[str, ...]:
        # `with_output` makes several networks of one file.
        return self.sha256, *(value.name for value in self.model.graph.output)

    def __getstate__(self) -> dict[str, object]:
        # A session of onnxruntime cannot be pickled; the copy opens one of its own.
        return {key: value for key, value in vars(self).items() if key != "_session"}

    def __repr__(self) -> str:
        suffix = f", for {self.sensor}" if self.sensor else ""
        return (
            f"Network({self.name!r}: {self.precision}, {len(self.model.graph.node)} nodes{suffix})"
        )


def other_precision(network: Network) -> Network | None:
    """Return the shipped network of the same architecture in the other precision, to compare times.

    Its sensor is the default one, because times depend only on the shapes of the layers. Return
    None if the architecture that the file's metadata names is not shipped.
    """
    variant = metadata(network.model).get("variant", "")
    if variant not in shipped_names():
        return None
    return Network.load(variant, sensor=SENSOR, int8=network.precision != "int8")
