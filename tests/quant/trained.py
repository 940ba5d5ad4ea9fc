"""Helpers that compare a trainable core with the integer reference."""

from typing import Any

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.quant.core import IntCore
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    AveragePool,
    Conv,
    Graph,
    MaxPool,
    Mul,
    Pointwise,
    Resize,
    Shuffle,
    Window,
)
from beers_deploy.quant.host_part import FINE_MAX
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.integer.trainable import TrainableCore


def odd_operations(generator: np.random.Generator) -> Graph:
    """Build a graph with uneven pads, groups, dilation, shuffles, pools, and unequal scales."""

    def conv(
        name: str, source: str, shape: tuple[int, ...], window: Window, groups: int = 1, **more: Any
    ) -> Conv:
        weight = generator.normal(0, 0.3, shape).astype(np.float32)
        return Conv(
            name,
            source,
            name,
            weight,
            generator.normal(0, 0.2, shape[0]).astype(np.float32),
            window=window,
            groups=groups,
            **more,
        )

    return (
        conv(
            "a",
            PLANES,
            (8, 3, 3, 2),
            Window((2, 1), (1, 0, 2, 1)),
            activation=Activation.leaky_relu,
        ),
        conv(
            "b",
            "a",
            (8, 4, 3, 3),
            Window((1, 1), (2, 2, 2, 2), (2, 2)),
            2,
            activation=Activation.relu6,
        ),
        Add("c", ("a", "b"), "c", Activation.leaky_relu),
        Shuffle("d", "c", "d", 2, True, False),
        MaxPool("e", "d", "e", (3, 2), Window((1, 2), (2, 0, 1, 1))),
        AveragePool("f", "e", "f", (2, 3), Window((1, 1), (0, 1, 1, 2))),
        conv("g", "f", (4, 1, 3, 4), Window((2, 3), (0, 2, 1, 1)), 2, transposed=True),
        Shuffle("h", "g", "h", 1, False, True),
        Pointwise("i", "h", "i", Activation.hard_swish),
        Mul("j", ("i", "h"), "j"),
        conv("k", "j", (1, 4, 1, 1), Window()),
        Resize("l", "k", CORRECTION, 2, True),
    )


def moved(core: IntCore) -> TrainableCore:
    """Return a core whose weights and biases are off by a unit or so, as after training."""
    generator = torch.Generator().manual_seed(3)
    trainable = TrainableCore(core)
    with torch.no_grad():
        for numbers in trainable.parameters():
            numbers.add_(0.7 * torch.randn(numbers.shape, generator=generator))
    return trainable


def assert_equals_reference(trainable: TrainableCore, planes: np.ndarray) -> None:
    """Check that all tensors equal those of the integer reference.

    A correction in copies may differ by half a unit where a fine copy holds it.
    """
    core = trainable.core()
    expected, _ = run_core(core, planes)
    with torch.no_grad():
        tensors = trainable.tensors(torch.from_numpy(planes.astype(np.float32)))
        result = trainable(torch.from_numpy(planes.astype(np.float32))).numpy()
    decoding = core.host_part.decoding
    correction = merged_correction(core, expected)
    for name, values in expected.items():
        if name != CORRECTION or decoding.copies == 1:
            assert_array_equal(tensors[name].numpy(), values, err_msg=name)
    if decoding.copies == 1:
        assert_allclose(result, correction, rtol=1e-6)
        return
    sizes = np.split(np.abs(expected[CORRECTION]), decoding.copies, axis=1)
    fine_copies = [size for size, gain in zip(sizes, decoding.gains, strict=True) if gain == 1]
    fine = np.min(fine_copies, axis=0) <= FINE_MAX
    # Windows hold every value in a fine copy. A dual range holds only small values there.
    assert fine.any() or not decoding.offsets
    assert np.abs(result - correction)[fine].max(initial=0) <= 0.501 * core.scale(CORRECTION)
