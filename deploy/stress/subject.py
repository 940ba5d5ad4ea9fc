"""What is under test: a float network and its INT8 file, opened once."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnx
import onnxruntime as ort
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pixel_shuffle, pixel_unshuffle

from deploy.export import float_model
from deploy.networks import Say, float_file, int8_file, shipped_pair, silent
from deploy.restoration.engine import restore_floats
from deploy.restoration.plan import make_plan
from deploy.restoration.runtime import Infer
from deploy.stress.cases import FULL_DN
from model.shipped import SENSOR
from profiles import load_sensor
from profiles.errors import BeersError
from quant.core import IntCore
from quant.encodings import read_core
from quant.graph import CORRECTION, IMAGE, Activation, Add, Conv, Graph, correction_graph, image_channels
from quant.onnx_file import any_size, load_onnx, require_quantised
from quant.session import open_session, run
from quant.tiling.walk import Tiling, tiling_of

T = TypeVar("T")

WHOLE_PX = 4096
"""A tile that no case fills."""


@dataclass(frozen=True)
class Network:
    """A network's file: how it runs, and how far it sees."""

    model: onnx.ModelProto

    @cached_property
    def tiling(self) -> Tiling:
        """How it meets an image of any size."""
        return tiling_of(any_size(self.model))

    @property
    def radius_px(self) -> int:
        """How far from a pixel its result depends on."""
        return self.tiling.halo_px

    def extended(self, image: np.ndarray) -> np.ndarray:
        """An image (N, 1, H, W) with copies of its last row and column, up to what the network takes whole."""
        lack = [self.tiling.whole_px(side) - side for side in image.shape[2:]]
        return np.pad(image, ((0, 0), (0, 0), (0, lack[0]), (0, lack[1])), mode="edge")

    def infer(self, threads: int = 1) -> Infer:
        """The network ready to run on so many threads, opened once for each number of them."""
        if threads not in self._opened:
            self._opened[threads] = open_session(any_size(self.model), threads)
        return partial(run, self._opened[threads])

    def restore(self, image: np.ndarray, threads: int = 1, tile_px: int = WHOLE_PX) -> np.ndarray:
        """As `restore` restores digital numbers (H, W) float: tiled, missing pixels kept, clipped, not rounded.

        Raises:
            ImageError: numbers outside 0 to full scale, or a network that gives NaN.
        """
        return restore(self.infer(threads), image, self.tiling, tile_px)

    @cached_property
    def _opened(self) -> dict[int, ort.InferenceSession]:
        return {}


@dataclass(frozen=True)
class Subject:
    """The pair of networks under test.

    Attributes:
        float32: the float one.
        int8: the INT8 one, or None.
        paths: the files they came from.
    """

    float32: Network
    int8: Network | None
    paths: tuple[Path, ...]

    @cached_property
    def graph(self) -> Graph | BeersError:
        """The float network's operations, or why they cannot be told."""
        return _or_reason(lambda: correction_graph(self.float32.model))

    @cached_property
    def core(self) -> IntCore | BeersError | None:
        """The INT8 file's whole numbers, or why they cannot be told; None without a file."""
        int8 = self.int8
        return None if int8 is None else _or_reason(lambda: read_core(int8.model))


def open_subject(
    float_path: Path | None, int8_path: Path | None, variant: str, sensor: str = SENSOR, say: Say = silent
) -> Subject:
    """The files given, or a shipped network in both precisions where neither is, told the sensor.

    Raises:
        ModelError: no such file or variant, the two swapped, or a network that cannot be tiled.
    """
    if float_path is None:
        float_path, int8_path = shipped_pair(variant, sensor, say)
    known = load_sensor(sensor)
    float_path = float_file(float_path, known, say)
    int8_path = int8_file(int8_path, known, say) if int8_path else None
    float32 = Network(float_model(float_path))
    int8 = None if int8_path is None else Network(load_onnx(int8_path))
    for path, network, wanted in ((float_path, float32, False), (int8_path, int8, True)):
        if path is not None and network is not None:
            require_quantised(network.model, path, wanted)
            _ = network.radius_px  # refuses what cannot be tiled before anything runs
    paths = (float_path,) if int8_path is None else (float_path, int8_path)
    return Subject(float32, int8, paths)


def restore(infer: Infer, image: np.ndarray, tiling: Tiling, tile_px: int = WHOLE_PX) -> np.ndarray:
    """The command's own way from digital numbers (H, W) to restored ones, float32, not rounded, with exact seams.

    Raises:
        ImageError: numbers outside 0 to full scale, or a network that gives NaN.
    """
    return restore_floats(image, infer, make_plan((1, *image.shape), tile_px, tiling.halo_px, tiling), FULL_DN)


def _or_reason(work: Callable[[], T]) -> T | BeersError:
    try:
        return work()
    except BeersError as error:
        return error


def infer_in(graph: Graph, dtype: torch.dtype, sum_dtype: torch.dtype = torch.float64) -> Infer:
    """The image plus the graph's correction, the correction computed in `dtype`, the sum in `sum_dtype`.

    bfloat16 is what training computes in where autocast is on; the global add stays in float32 there.
    """

    def infer(image: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            restored = _as(image, sum_dtype) + _correction(graph, _as(image, dtype)).to(sum_dtype)
        return np.asarray(restored.numpy())

    return infer


def steepest_signs(graph: Graph, image: np.ndarray) -> np.ndarray:
    """The change (H, W) of -1, 0 or 1 that moves the middle pixel most, to first order: its gradient's signs."""
    pixels = _as(image, torch.float32)[None, None].requires_grad_()
    restored = pixels + _correction(graph, pixels)
    (gradient,) = torch.autograd.grad(restored[0, 0, image.shape[0] // 2, image.shape[1] // 2], pixels)
    return np.asarray(gradient[0, 0].sign().numpy())


def _correction(graph: Graph, image: Tensor) -> Tensor:
    place_px = math.isqrt(image_channels(graph))
    tensors = {IMAGE: pixel_unshuffle(image, place_px)}
    for op in graph:
        if isinstance(op, Add):
            tensors[op.output] = tensors[op.inputs[0]] + tensors[op.inputs[1]]
            continue
        assert isinstance(op, Conv)  # noqa: S101 - correction_graph has seen to it
        weight, bias = (_as(values, image.dtype) for values in (op.weight, op.bias))
        result = conv2d(tensors[op.input], weight, bias, padding=op.window.pads[0])
        tensors[op.output] = torch.relu(result) if op.activation is Activation.relu else result
    return pixel_shuffle(tensors[CORRECTION], place_px)


def _as(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).to(dtype)
