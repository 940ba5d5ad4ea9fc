"""The networks under test, opened once, and the checks of each stage of the battery."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import onnxruntime as ort
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pixel_shuffle, pixel_unshuffle

from beers_deploy.comparison import pair_of
from beers_deploy.conditioned_file import conditioned_on
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import BeersError, ModelError
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.quant.bounds import layer_bounds
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
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.onnx.image_input import any_size
from beers_deploy.quant.onnx_file import require_quantized
from beers_deploy.quant.session import open_session, run
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from beers_deploy.restoration.plan import make_plan
from beers_deploy.restoration.runtime import Infer
from beers_deploy.restoration.tiles.rows import restore_floats
from beers_deploy.results import Input
from beers_deploy.studies.stress import checks
from beers_deploy.studies.stress.cases import FULL_DN, Case

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
        return restore_floats(image, self.infer(threads), plan, FULL_DN)


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
    float_network: NetworkLike | None = None,
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
    if int8_network is not None or _is_pair(float_network):
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


def _is_pair(network: NetworkLike | None) -> bool:
    """Return True if a network stands for a pair: the default one, a shipped name, or an origin."""
    if isinstance(network, Network):
        return network.origin is not None
    if isinstance(network, str | os.PathLike):
        return not (Path(network).suffix or Path(network).exists())
    return network is None


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


def steepest_signs(graph: Graph, image: np.ndarray) -> np.ndarray:
    """Return the change of the input that moves the restored pixel in the middle most, to first
    order.

    Args:
        graph: the network's convolutions and additions.
        image: shares of full scale, (H, W).

    Returns:
        The signs of the gradient of the middle pixel, -1, 0 or 1, (H, W).
    """
    pixels = torch.from_numpy(image)[None, None].requires_grad_()
    middle = in_torch(graph, pixels)[0, 0, image.shape[0] // 2, image.shape[1] // 2]
    (gradient,) = torch.autograd.grad(middle, pixels)
    return np.asarray(gradient[0, 0].sign().numpy())


GAIN_DN = 16.0
STEEPEST_DN = 64.0
FLOAT32_DN = 0.05
INT8_GAIN_DN = 128.0
"""The bound of the INT8 gain. A change of 1 DN can change a rounding in every layer, and move a
pixel from the fine gain to the coarse one.
"""
ROUNDING_DN = 128.0
"""The bound of the effect of the DPU's tie rounding (half up): one unit in any layer,
propagated.
"""
MORE_THREADS = 2
CROP_PX = 48
CORES_PX = (16, 29)
LARGE_CORE_PX = 250
"""The side of a tile without its two halos, for large images."""


def float32(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Check the float network in float32, and against float64 if it has only convolutions.

    Args:
        subject: the networks under test.
        case: the hard case that the image belongs to.
        image: the image (H, W) in DN.
    """
    network = subject.float32
    graph = subject.graph
    measures = restoration(network, case, image, GAIN_DN)
    if case.pixels == "sound" and not case.large and graph is not None:
        extended = network.extended(_fractions(image))
        exact = in_torch(graph, torch.from_numpy(extended).double()).numpy()
        error = FULL_DN * float(np.abs(network.infer()(extended) - exact).max())
        signs = steepest_signs(graph, extended[0, 0])[: image.shape[0], : image.shape[1]]
        steepest = checks.change(network.restore, image, network.restore(image), signs)
        measures.append(checks.Measure("error against float64", error, FLOAT32_DN))
        measures.append(checks.Measure("gain, steepest", steepest, STEEPEST_DN, "DN per DN"))
    return measures


def int8(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Check the INT8 network with onnxruntime's integer kernels on an image (H, W) in DN."""
    network = subject.quantized
    measures = restoration(network, case, image, INT8_GAIN_DN)
    if case.pixels == "sound" and not case.large:
        apart = np.abs(network.restore(image) - subject.float32.restore(image))
        error = float(apart.mean())
        measures.append(checks.Measure("mean error against float", error, checks.FLAT_DN))
    return measures


def restoration(
    network: Runner, case: Case, image: np.ndarray, gain_dn: float
) -> list[checks.Measure]:
    """Run the checks that apply to a network of any precision: finite and in range, the same in
    every run, ringing, brightness and gain.

    Args:
        network: the network.
        case: the hard case that the image belongs to. If its pixels are infinite or beyond 12 bits,
            the network must refuse the image.
        image: the image (H, W) in DN.
        gain_dn: the largest change of a restored pixel that a change of 1 DN may cause.
    """
    if case.pixels in ("infinite", "beyond"):
        return [checks.refused(lambda: network.restore(image))]
    result = network.restore(image)
    valid = ~np.isnan(image)
    measures = [checks.not_finite(result[valid]), checks.out_of_range(result)]
    if case.large:
        return measures
    measures.append(checks.differing("runs differ", result, network.restore(image)))
    measures.append(
        checks.differing("threads differ", result, network.restore(image, MORE_THREADS))
    )
    if case.pixels == "missing":
        return [*measures, checks.differing("missing moved", result[~valid], image[~valid])]
    largest = checks.gain(network.restore, image, result, np.random.default_rng(0))
    measures += checks.fidelity(image, result, network.tiling.halo_px, case.flat)
    return [*measures, checks.Measure("gain", largest, gain_dn, "DN per DN")]


def reference(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Check the INT8 network by the integer reference, layer by layer.

    The reference computes the integers of each layer in NumPy. The runtime must agree with it bit
    for bit, no accumulator may exceed its proven bound, and only layers whose bounds allow it may
    saturate. Rounding ties up, as a DPU does, may change the result by at most ROUNDING_DN. Images
    (H, W) in DN are cropped to CROP_PX, because the reference is slow.
    """
    core = subject.core
    network = subject.quantized
    if case.pixels != "sound":
        return []
    crop = network.extended(_fractions(image[:CROP_PX, :CROP_PX]))
    planes = core.host_part.encode(crop)
    # onnxruntime rounds ties to even, and the DPU rounds them up.
    even, reports = run_core(core, planes, half_even=True)
    up, _ = run_core(core, planes)
    by_rule, on_board = (
        core.host_part.finish(crop, merged_correction(core, tensors))[0, 0]
        for tensors in (even, up)
    )
    # A peak above its proof would mean that the proof is wrong, not the network.
    over = max(report.peak_bits - report.proven_bits for report in reports)
    can = {bound.name for bound in layer_bounds(core) if bound.saturates}
    unproven = [
        report.name for report in reports if report.saturated > 0 and report.name not in can
    ]
    return [
        checks.not_finite(by_rule),
        checks.differing("runtime differs", by_rule, network.infer()(crop)[0, 0]),
        checks.Measure(
            "DPU's tie rounding", FULL_DN * float(np.abs(on_board - by_rule).max()), ROUNDING_DN
        ),
        checks.Measure("accumulator beyond its proof", over, 0, "bits"),
        checks.Measure("saturation not reported", len(unproven), 0, "layers"),
    ]


def _fractions(image: np.ndarray) -> np.ndarray:
    return (np.asarray(image, np.float32) / np.float32(FULL_DN))[None, None]


def tiling(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Compare both networks, tiled by several plans, with the whole image (H, W).

    The tiles must give the result of the whole image, bit for bit. If the pixels of the case are
    infinite or beyond 12 bits, the networks must refuse the image in tiles too.
    """
    measures = []
    cores_px = (LARGE_CORE_PX,) if case.large else CORES_PX
    for name, network in subject.by_name.items():
        ways = [
            partial(network.restore, image, tile_px=2 * network.tiling.halo_px + core_px)
            for core_px in cores_px
        ]
        if case.pixels in ("infinite", "beyond"):
            measures += [checks.refused(way) for way in ways]
        else:
            untiled = network.restore(image)
            measures += [checks.differing(f"{name} plans differ", way(), untiled) for way in ways]
    return measures


Stage = Callable[[Subject, Case, np.ndarray], list[checks.Measure]]

STAGES: dict[str, Stage] = {
    "float32": float32,
    "INT8": int8,
    "INT8 reference": reference,
    "tiling": tiling,
}
