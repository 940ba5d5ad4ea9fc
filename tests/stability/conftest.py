"""Fixtures: a small network, its quantized form, and the stress subjects made from them."""

from collections.abc import Iterator
from pathlib import Path

import onnx
import pytest
import torch

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS
from beers_deploy.model.traditional.rows import one_thread_per_operation
from beers_deploy.model.variants import Variant
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.quant.quantize import Quantized
from beers_deploy.studies.stress.networks import Subject, open_subject
from tests.model.networks import plain
from tests.quant.quick import drawn, quickly


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Use one thread: on images this small a second one only waits."""
    with one_thread_per_operation():
        yield


@pytest.fixture(scope="session")
def network() -> ConvBEERS:
    return small_network(Variant(blocks=1, features=6))


def small_network(variant: Variant) -> ConvBEERS:
    created = plain(variant, seed=3)
    with torch.no_grad():
        # A trained network leaves flat ground unchanged; with a small tail a new one nearly does.
        created.tail.weight.mul_(0.03)
    return created


@pytest.fixture(scope="session")
def float_onnx(network: ConvBEERS) -> onnx.ModelProto:
    return to_onnx(network, {"variant": "test"})


@pytest.fixture(scope="session")
def quantized(float_onnx: onnx.ModelProto) -> Quantized:
    return quickly_quantized(float_onnx)


def quickly_quantized(float_onnx: onnx.ModelProto) -> Quantized:
    return quickly(float_onnx, drawn(2, seed=5))


@pytest.fixture(scope="session")
def pair(
    float_onnx: onnx.ModelProto, quantized: Quantized, tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """Return the paths of the float and the INT8 file."""
    return save_pair(float_onnx, quantized, tmp_path_factory.mktemp("pair"))


def save_pair(float_onnx: onnx.ModelProto, quantized: Quantized, folder: Path) -> list[Path]:
    paths = [folder / "float.onnx", folder / "int8.onnx"]
    for model, path in zip((float_onnx, quantized.host), paths, strict=True):
        save_onnx(model, path)
    return paths


@pytest.fixture(scope="session")
def subject(pair: list[Path]) -> Subject:
    return open_subject(pair[0], pair[1])


@pytest.fixture(scope="session")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    """Return a network at half resolution, in both precisions."""
    model = to_onnx(small_network(Variant(blocks=1, features=8, scale=2)), {"variant": "test"})
    paths = save_pair(model, quickly_quantized(model), tmp_path_factory.mktemp("coarse"))
    return open_subject(paths[0], paths[1])
