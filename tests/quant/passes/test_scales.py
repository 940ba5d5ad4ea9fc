"""Tests that scales moved between rounds of training are better, legal, and still tied."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.quant.core import SHIFTS, IntCore, Shifts, build_core, shift_faults
from beers_deploy.quant.graph import CORRECTION, PLANES, Add, Conv, Graph, ties_scales
from beers_deploy.quant.integer.trainable import TrainableCore
from beers_deploy.quant.passes.scales import moved, with_better_scales
from tests.quant.quick import with_relu6
from tests.quant.trained import assert_equals_reference, odd_operations

PLANES_OF_NOISE = np.random.default_rng(0).integers(-128, 128, (1, 3, 12, 10)).astype(np.int8)


def distance(core: IntCore, target: torch.Tensor) -> float:
    """Return the mean squared difference between a core's correction of noise and a target."""
    return float((correction_of(core) - target).square().mean())


def correction_of(core: IntCore) -> torch.Tensor:
    """Return a core's correction of noise."""
    planes = torch.from_numpy(PLANES_OF_NOISE.astype(np.float32))
    with torch.no_grad():
        correction: torch.Tensor = TrainableCore(core)(planes)
    return correction


def chain(seed: int) -> tuple[Graph, IntCore]:
    """Return two convolutions in float and in integers."""
    generator = np.random.default_rng(seed)

    def conv(name: str, source: str, shape: tuple[int, ...]) -> Conv:
        """Return a convolution with drawn weights and biases."""
        weight = generator.normal(0, 1, shape).astype(np.float32)
        return Conv(name, source, name, weight, weight.mean((1, 2, 3)))

    graph = conv("a", PLANES, (4, 3, 1, 1)), conv(CORRECTION, "a", (1, 4, 1, 1))
    return graph, build_core(graph, {PLANES: 7, "a": 5, CORRECTION: 4})


@pytest.mark.parametrize("by", [-1, 1])
def test_a_tensor_whose_scale_was_moved_comes_back(by: int) -> None:
    """A tensor that is a bit too fine or too coarse gets its old scale back, and with it the old
    result.
    """
    graph, core = chain(1)
    start = TrainableCore(core).with_finer_tensors(["a"], by=by)
    target = correction_of(core)
    better = with_better_scales(start, graph, SHIFTS, lambda each: distance(each, target))
    assert distance(better.core(), target) == 0
    assert better.core().frac_bits == core.frac_bits


def test_coarse_weights_become_finer() -> None:
    """Weights that are a bit too coarse become finer again, although the bits that were lost
    stay lost.
    """
    graph, core = chain(2)
    target = correction_of(core)
    start = TrainableCore(core).with_finer_numbers("weight", 0, by=-1)
    before = distance(start.core(), target)
    assert before > 0
    better = with_better_scales(start, graph, SHIFTS, lambda each: distance(each, target)).core()
    assert distance(better, target) < before
    assert better.convolutions[0].weight_frac_bits == core.convolutions[0].weight_frac_bits


def tried(core: IntCore, graph: Graph, shifts: Shifts = SHIFTS) -> list[IntCore]:
    """Return every core that is tried, with a falling loss, so that each move is kept."""
    cores = list[IntCore]()

    def loss_of(candidate: IntCore) -> float:
        """Note a core, and return a loss that is lower each time."""
        cores.append(candidate)
        return -len(cores)

    with_better_scales(TrainableCore(core), graph, shifts, loss_of)
    return cores[1:]


def exact_adds(core: IntCore) -> set[str]:
    """Return the names of the adds that have one scale."""
    names = set[str]()
    for op in core.ops:
        scales = {core.frac_bits[name] for name in (*op.inputs, op.output)}
        if isinstance(op, Add) and len(scales) == 1:
            names.add(op.name)
    return names


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), same=st.booleans())
def test_every_core_tried_is_legal_and_trained_as_the_reference_runs_it(
    seed: int, same: bool
) -> None:
    """Each core that is tried fits the DPU's shifts, and keeps the planes' and the ReLU6's scales.

    Adds that were exact stay so, and training computes the last core as the reference does.
    """
    generator = np.random.default_rng(seed)
    graph = odd_operations(generator)
    low, high = (5, 6) if same else (4, 7)
    bits = {op.output: int(generator.integers(low, high)) for op in graph} | {PLANES: 7}
    core = build_core(graph, bits)
    cores = tried(core, graph)
    exact = exact_adds(core)
    assert moved(core, cores[-1]) > 0
    for each in cores:
        assert shift_faults(each) == []
        # `shift_faults` checks ties. Exact adds stay exact because their tensors move jointly.
        assert exact_adds(each) >= exact
        assert each.frac_bits[PLANES] == 7
        assert each.frac_bits["b"] == core.frac_bits["b"]
    assert_equals_reference(TrainableCore(cores[-1]), PLANES_OF_NOISE)


def test_tensors_that_share_a_scale_move_jointly() -> None:
    """Tensors that must share a scale share it in every core, however many moves were kept."""
    graph = odd_operations(np.random.default_rng(3))
    core = build_core(graph, {op.output: 5 for op in graph} | {PLANES: 7})
    after = tried(core, graph)[-1]
    for op in after.ops:
        if ties_scales(op):
            assert len({after.frac_bits[name] for name in (*op.inputs, op.output)}) == 1
    assert moved(core, after) > 3


def test_finer_weights_stand_for_the_same_values() -> None:
    """Weights that become coarser and finer again keep the coarser values, on the finer scale."""
    _, core = chain(2)
    coarse = TrainableCore(core).with_finer_numbers("weight", 0, by=-2)
    fine = coarse.with_finer_numbers("weight", 0, by=2)
    before, after = (each.core().convolutions[0] for each in (coarse, fine))
    assert np.any(before.weight)
    assert after.weight_frac_bits == before.weight_frac_bits + 2
    error = (
        after.weight * 2.0**-after.weight_frac_bits - before.weight * 2.0**-before.weight_frac_bits
    )
    assert np.abs(error).max() <= 2.0**-before.weight_frac_bits / 2


def test_where_relu6_clips_the_end_of_int8_stays() -> None:
    """Only the result's scale may move: ReLU6 writes the others, and its 6 may be int8's end."""
    graph = with_relu6(1.0)
    core = build_core(graph, {PLANES: 7, "a": 4, "b": 4, "c": 5, CORRECTION: 5})
    for each in tried(core, graph):
        differing = {name for name, bits in each.frac_bits.items() if bits != core.frac_bits[name]}
        assert differing <= {CORRECTION}


def test_a_range_of_shifts_is_kept() -> None:
    """No move leaves a narrower range of shifts, as other targets have one."""
    graph, core = chain(4)
    cuts = [
        op.weight_frac_bits + core.frac_bits[op.input] - core.frac_bits[op.output]
        for op in core.convolutions
    ]
    assert min(cuts) < max(cuts)
    narrow = replace(SHIFTS, shift_cut=(min(cuts), max(cuts)))
    assert all(shift_faults(each, narrow) == [] for each in tried(core, graph, narrow))
    # In a range of one shift no single scale can move.
    assert tried(core, graph, replace(SHIFTS, shift_cut=(min(cuts), min(cuts)))) == []


def test_a_worse_core_is_not_kept() -> None:
    """If every move makes the loss worse, the core is the one before, number by number."""
    graph, core = chain(5)
    losses = iter(range(100))
    same = with_better_scales(TrainableCore(core), graph, SHIFTS, lambda _: next(losses)).core()
    assert moved(core, same) == 0
    for one, other in zip(core.convolutions, same.convolutions, strict=True):
        np.testing.assert_array_equal(one.weight, other.weight)
        np.testing.assert_array_equal(one.bias, other.bias)
