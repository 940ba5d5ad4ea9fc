"""Tests that C and Aidge compute the golden integers, and onnxruntime except for ties.

Aidge runs where BEERS_AIDGE_PYTHON names the Python of its environment (`benchmarks.executors`).
"""

import os
import shutil
from pathlib import Path

import pytest
from numpy.testing import assert_array_equal

from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.network import Network
from beers_deploy.quant.graph import Activation, Pointwise
from benchmarks.executors import Vectors
from benchmarks.small_networks import NETWORKS
from tests.golden.small_networks import quantized

pytestmark = pytest.mark.slow
AIDGE = os.environ.get("BEERS_AIDGE_PYTHON")
TILE_PX = 32


@pytest.fixture(scope="module", params=[*shipped_names(), *NETWORKS])
def vectors(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Vectors:
    name = request.param
    source = f"{name}{INT8}"
    if name in NETWORKS:
        source = str(quantized(name, tmp_path_factory.mktemp("small")))
    return Vectors.of(Network.load(source, int8=True), TILE_PX)


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_c_computes_the_golden_integers(vectors: Vectors, compiler: str) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler}")
    assert_array_equal(vectors.by_c([compiler, "-O2"]), vectors.result)


def test_onnxruntime_differs_by_ties_alone(vectors: Vectors) -> None:
    even = vectors.half_even()
    host = vectors.by_onnxruntime_host()
    assert_array_equal(host, even[: len(host)])
    assert 0 < vectors.differing(even) < 0.5
    # The core looks a separate activation up in a table, which rounds ties up in any case.
    if not any(isinstance(op, Pointwise) for op in vectors.core.ops):
        assert_array_equal(vectors.by_onnxruntime_board(), even)


@pytest.mark.skipif(AIDGE is None, reason="BEERS_AIDGE_PYTHON names no environment of Aidge")
def test_aidge_computes_the_golden_integers(vectors: Vectors) -> None:
    result = vectors.by_aidge(Path(str(AIDGE)))
    # A board's file has ONNX's own HardSwish, a DPU an approximation in fixed point.
    hard = (Activation.hard_sigmoid, Activation.hard_swish)
    if any(isinstance(op, Pointwise) and op.activation in hard for op in vectors.core.ops):
        assert 0 < vectors.differing(result) < 0.2
    else:
        assert_array_equal(result, vectors.result)
