"""The networks under test, opened once."""

import math
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import onnxruntime as ort
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pixel_shuffle, pixel_unshuffle

from beers_deploy.comparison import pair_of, stands_for_pair
from beers_deploy.conditioned_file import conditioned_on
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import BeersError, ModelError
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.graph import (
    CORRECTION,
    IMAGE,
    Activation,
    Add,
    Conv,
    Graph,
    correction_graph,
    image_channels,
)
from beers_deploy.quant.input_range import in_words
from beers_deploy.quant.onnx.image_input import any_size
from beers_deploy.quant.onnx_file import require_quantized
from beers_deploy.quant.session import open_session, run
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from beers_deploy.restoration.plan import make_plan
from beers_deploy.restoration.runtime import Infer
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import restore_floats
from beers_deploy.results import Input
from beers_deploy.studies.stress.cases import FULL_DN

WHOLE_PX = 4096
"""The side of a tile that is larger than any case."""


@dataclass(frozen=True)
class Runner:
    """A network under test, which restores images of any size in memory with onnxruntime.

    Attributes:
        source: the loaded network.
    """

    source: Network
    _sessions: dict[int, ort.InferenceSession] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def tiling(self) -> Tiling:
        """The tiling geometry of the network: its receptive radius, stride and scale."""
        return tiling_of(any_size(self.source.model))

    def extended(self, image: np.ndarray) -> np.ndarray:
        """Return an image (N, 1, H, W) with its last row and column repeated, up to a size that the
        network accepts.
        """
        lack = [self.tiling.whole_px(side) - side for side in image.shape[2:]]
        return np.pad(image, ((0, 0), (0, 0), (0, lack[0]), (0, lack[1])), mode="edge")

    def infer(self, threads: int = 1) -> Infer:
        """Return the network ready to run, opened once for each number of threads.

        Args:
            threads: the number of threads of onnxruntime.

        Returns:
            A function from images (N, 1, H, W) float32 in [0, 1] to the network's results.
        """
        if threads not in self._sessions:
            self._sessions[threads] = open_session(any_size(self.source.model), threads)
        return partial(run, self._sessions[threads])

    def restore(self, image: np.ndarray, threads: int = 1, tile_px: int = WHOLE_PX) -> np.ndarray:
        """Restore one image as `restore` does, without the steps around the network.

        Args:
            image: digital numbers (H, W) of 12 bits, float; NaN marks a missing pixel.
            threads: the number of threads of onnxruntime.
            tile_px: the side of a tile; the default is larger than any hard case.

        Returns:
            Restored digital numbers (H, W), clipped to 12 bits, not rounded; NaN stays.

        Raises:
            ImageError: a pixel is infinite or outside 12 bits.
        """
        plan = make_plan((1, *image.shape), tile_px, self.tiling.halo_px, self.tiling)
        network = ExposedNetwork({1: self.infer(threads)})
        return restore_floats(image, network, plan, FULL_DN)


@dataclass(frozen=True)
class Subject:
    """The networks under test: a float network and, if there is one, its INT8 network.

    Attributes:
        float32: the float network.
        int8: the INT8 network; None if only the float network is tested.
    """

    float32: Runner
    int8: Runner | None = None

    @property
    def by_name(self) -> dict[str, Runner]:
        """The networks under test by precision, "float32" and, if there is one, "INT8"."""
        networks = {"float32": self.float32, "INT8": self.int8}
        return {name: network for name, network in networks.items() if network is not None}

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The networks under test as inputs of a table of results, with their digests."""
        return tuple(network.source.input for network in self.by_name.values())

    @cached_property
    def graph(self) -> Graph | None:
        """The float network as convolutions and additions alone, or None if it has other
        operators.
        """
        try:
            return correction_graph(self.float32.source.model)
        except BeersError:
            return None

    @cached_property
    def core(self) -> IntCore:
        """The integer operations that the INT8 network's file stores.

        Raises:
            ModelError: there is no INT8 network, or its file has no integer core.
        """
        return read_core(self.quantized.source.model)

    @property
    def quantized(self) -> Runner:
        """The INT8 network.

        Raises:
            ModelError: only a float network is tested.
        """
        if self.int8 is None:
            raise ModelError("The INT8 network is missing. Give its file as the second argument.")
        return self.int8


def open_subject(
    float_network: NetworkLike | None,
    int8_network: NetworkLike | None = None,
    sensor: SensorLike = SENSOR,
) -> Subject:
    """Open the networks to test: a float network and, if there is one, its INT8 network.

    Args:
        float_network: the float network. A shipped name, or an INT8 network that was quantised in
            this process, stands for both networks; None for the default pair.
        int8_network: the INT8 network; None tests only the float network, unless `float_network`
            stands for both.
        sensor: the sensor that shipped networks are conditioned on.

    Raises:
        ModelError: a network cannot be tiled, has several bands, changes the size or reads other
            values than [0, 1], or the float and the INT8 network are swapped.
    """
    profile = Sensor.load(sensor)
    if int8_network is not None or stands_for_pair(float_network):
        floating, int8 = pair_of(float_network, int8_network, profile)
        # A file for every sensor is tested under the sensor that the float network has.
        if floating.profile is not None:
            int8 = conditioned_on(int8, floating.profile)
        subject = Subject(Runner(floating), Runner(int8))
    else:
        floating = Network.load(float_network, sensor=profile, int8=False)
        require_quantized(floating.model, floating.label, expected=False)
        subject = Subject(Runner(floating))
    for network in subject.by_name.values():
        # A network that cannot be tiled is refused before anything runs.
        tiling = network.tiling
        if (tiling.channels_in, tiling.channels_out) != (1, 1) or tiling.scale != 1:
            raise ModelError(
                f"{network.source.label} is a network {tiling.words}, but stress tests are for "
                "networks that make one band of one band, in the same size."
            )
        if network.source.input_ranges:
            raise ModelError(
                f"{network.source.label} reads images of {in_words(network.source.input_ranges)}, "
                "but stress tests are for networks that read images in [0, 1]."
            )
    return subject


def in_torch(graph: Graph, image: Tensor) -> Tensor:
    """Run a network in torch, in the precision of the image, such as float64.

    Args:
        graph: the network's convolutions and additions, which compute a correction of the image.
        image: shares of full scale, (N, 1, H, W).

    Returns:
        The image plus its correction, (N, 1, H, W), not clipped.
    """
    place_px = math.isqrt(image_channels(graph))
    tensors = {IMAGE: pixel_unshuffle(image, place_px)}
    for op in graph:
        if isinstance(op, Add):
            tensors[op.output] = tensors[op.inputs[0]] + tensors[op.inputs[1]]
            continue
        assert isinstance(op, Conv)  # noqa: S101 - correction_graph has seen to it
        weight, bias = (torch.from_numpy(values).to(image.dtype) for values in (op.weight, op.bias))
        result = conv2d(tensors[op.input], weight, bias, padding=op.window.pads[0])
        tensors[op.output] = torch.relu(result) if op.activation is Activation.relu else result
    return image + pixel_shuffle(tensors[CORRECTION], place_px)
