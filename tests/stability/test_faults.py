"""Bit flips: as many as were asked for, in numbers that the memory can hold, wherever they fall."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import IntConv
from beers_deploy.quant.graph import split
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.quantise import Quantised
from beers_deploy.studies.stress.faults import (
    SHIFT_BITS,
    as_stored,
    bits_apart,
    flip_bits,
    flip_count,
    flip_shifts,
    flip_weights,
    map_channels,
    shifts_of,
    weight_bits,
)

KINDS = {"int8": (np.int8, 8), "maps": (np.int16, 8), "pixels": (np.uint16, 12), "shifts": (np.int16, 6)}


def image(height: int = 21, width: int = 34) -> np.ndarray:
    return np.random.default_rng(5).random((1, 1, height, width), dtype=np.float32)


def flipped(a: np.ndarray, b: np.ndarray, bits: int) -> int:
    apart = (a.astype(np.int64) ^ b.astype(np.int64)) & ((1 << bits) - 1)
    return sum(int(value).bit_count() for value in apart.ravel())


@given(st.sampled_from(sorted(KINDS)), st.integers(0, 2**32 - 1), st.data())
def test_so_many_bits_are_flipped_and_no_more(kind: str, seed: int, data: st.DataObject) -> None:
    dtype, bits = KINDS[kind]
    low, high = (0, 2**bits) if kind == "pixels" else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    values = np.random.default_rng(seed).integers(low, high, (3, 7)).astype(dtype)
    count = data.draw(st.integers(0, values.size * bits))
    injected = flip_bits(values, count, np.random.default_rng(seed), bits)
    assert flipped(values, injected, bits) == count
    assert injected.dtype == values.dtype
    assert low <= injected.min() <= injected.max() < high
    again = flip_bits(values, count, np.random.default_rng(seed), bits)
    np.testing.assert_array_equal(injected, again)


def test_the_rate_is_that_of_a_megabit() -> None:
    """Poisson's standard deviation is the root of the mean."""
    counts = [flip_count(2_000_000, 50.0, np.random.default_rng(k)) for k in range(400)]
    assert np.mean(counts) == pytest.approx(100, abs=4 * 10 / 20)
    assert np.std(counts) == pytest.approx(10, rel=0.2)
    assert flip_count(1000, 0.0, np.random.default_rng(0)) == 0
    assert flip_count(1000, 1e9, np.random.default_rng(0)) == 1000


def test_the_stored_bias_is_int8_and_the_network_the_same(quantised: Quantised) -> None:
    stored = as_stored(quantised.core)
    convs = [op for op in stored.ops if isinstance(op, IntConv)]
    assert all(op.bias.dtype == np.int8 for op in convs)
    assert weight_bits(stored) == 8 * sum(op.weight.size + op.bias.size for op in convs)
    planes = split(image())
    before, after = run_core(quantised.core, planes)[0], run_core(stored, planes)[0]
    for name in before:
        np.testing.assert_array_equal(before[name], after[name])


def test_flips_fall_into_the_weights_of_all_layers(quantised: Quantised) -> None:
    core = as_stored(quantised.core)
    injected = flip_weights(core, 200, np.random.default_rng(1))
    apart = {
        a.name: flipped(a.weight, b.weight, 8) + flipped(a.bias, b.bias, 8)
        for a, b in zip(core.ops, injected.ops, strict=True)
        if isinstance(a, IntConv) and isinstance(b, IntConv)
    }
    assert sum(apart.values()) == 200
    assert sum(count > 0 for count in apart.values()) > len(apart) / 2


def test_every_shift_is_what_the_core_uses(quantised: Quantised) -> None:
    core = as_stored(quantised.core)
    shifts = shifts_of(core)
    assert len(shifts) == sum(2 if isinstance(op, IntConv) else 1 for op in core.ops)
    limit = 2 ** (SHIFT_BITS - 1)
    assert all(-limit <= shift < limit for shift in shifts.values())
    injected = flip_shifts(shifts, 3, np.random.default_rng(2))
    assert injected.keys() == shifts.keys()
    assert bits_apart(injected, shifts) == 3


def test_numbers_that_the_board_could_not_store_are_refused(quantised: Quantised) -> None:
    op = next(op for op in quantised.core.ops if isinstance(op, IntConv))
    odd = replace(op, bias=np.full(len(op.bias), 100_001), bias_frac_bits=op.bias_frac_bits)
    far = replace(op, weight_frac_bits=op.weight_frac_bits + 40, bias_frac_bits=op.bias_frac_bits + 40)
    for wrong in (odd, far):
        with pytest.raises(ModelError, match=op.name):
            as_stored(replace(quantised.core, ops=(wrong, *quantised.core.ops[1:])))


def test_maps_have_the_channels_that_run(quantised: Quantised) -> None:
    tensors, _ = run_core(quantised.core, split(image()))
    assert {name: tensor.shape[1] for name, tensor in tensors.items()} == map_channels(quantised.core)
