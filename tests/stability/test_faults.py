"""Tests of the number and place of injected bit flips, and of what the guards promise."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation
from beers_deploy.quant.host_part import IMAGE_SLICES
from beers_deploy.quant.integer.reference import NO_FAULTS, Faults, merged_correction, run_core
from beers_deploy.quant.quantize import Quantized
from beers_deploy.studies.stress.faults import (
    SHIFT_BITS,
    Guards,
    as_stored,
    bits_apart,
    checksums,
    flip_bits,
    flip_conv,
    flip_count,
    flip_shifts,
    flip_weights,
    guarded,
    learn_guards,
    map_channels,
    scrubbed,
    shifts_of,
    voted,
    weight_bits,
    with_ops,
)
from tests.quant.quick import image

KINDS = {
    "int8": (np.int8, 8),
    "maps": (np.int16, 8),
    "pixels": (np.uint16, 12),
    "shifts": (np.int16, 6),
}


def planes(seed: int = 0, light: float = 1.0) -> np.ndarray:
    """Return the planes of a noise image, as a core reads them."""
    return IMAGE_SLICES.encode(np.float32(light) * image(seed=seed))


def count_flips(a: np.ndarray, b: np.ndarray, bits: int) -> int:
    difference = (a.astype(np.int64) ^ b.astype(np.int64)) & ((1 << bits) - 1)
    return sum(int(value).bit_count() for value in difference.ravel())


@pytest.fixture(scope="module")
def core(quantized: Quantized) -> IntCore:
    return as_stored(quantized.core)


@given(st.sampled_from(sorted(KINDS)), st.integers(0, 2**32 - 1), st.data())
def test_exactly_the_given_number_of_bits_is_flipped(
    kind: str, seed: int, data: st.DataObject
) -> None:
    dtype, bits = KINDS[kind]
    low, high = (0, 2**bits) if kind == "pixels" else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    values = np.random.default_rng(seed).integers(low, high, (3, 7)).astype(dtype)
    count = data.draw(st.integers(0, values.size * bits))
    injected = flip_bits(values, count, np.random.default_rng(seed), bits)
    assert count_flips(values, injected, bits) == count
    assert injected.dtype == values.dtype
    assert low <= injected.min() <= injected.max() < high
    repeated = flip_bits(values, count, np.random.default_rng(seed), bits)
    assert_array_equal(injected, repeated)


def test_the_rate_is_per_million_bits() -> None:
    """The standard deviation of a Poisson distribution is the root of its mean."""
    counts = [flip_count(2_000_000, 50.0, np.random.default_rng(k)) for k in range(400)]
    assert np.mean(counts) == pytest.approx(100, abs=4 * 10 / 20)
    assert np.std(counts) == pytest.approx(10, rel=0.2)
    assert flip_count(1000, 0.0, np.random.default_rng(0)) == 0
    assert flip_count(1000, 1e9, np.random.default_rng(0)) == 1000


def test_the_stored_bias_is_int8_and_the_network_the_same(quantized: Quantized) -> None:
    stored = as_stored(quantized.core)
    assert all(op.bias.dtype == np.int8 for op in stored.convolutions)
    assert weight_bits(stored) == 8 * sum(
        op.weight.size + op.bias.size for op in stored.convolutions
    )
    before = run_core(quantized.core, planes())[0]
    after = run_core(stored, planes())[0]
    for name in before:
        assert_array_equal(before[name], after[name])


def test_flips_fall_into_the_weights_of_all_layers(core: IntCore) -> None:
    injected = flip_weights(core, 200, np.random.default_rng(1))
    flips = {
        a.name: count_flips(a.weight, b.weight, 8) + count_flips(a.bias, b.bias, 8)
        for a, b in zip(core.convolutions, injected.convolutions, strict=True)
    }
    assert sum(flips.values()) == 200
    assert sum(count > 0 for count in flips.values()) > len(flips) / 2


def test_shifts_cover_every_operator_and_fit_their_bits(core: IntCore) -> None:
    shifts = shifts_of(core)
    assert len(shifts) == sum(2 if isinstance(op, IntConv) else 1 for op in core.ops)
    limit = 2 ** (SHIFT_BITS - 1)
    assert all(-limit <= shift < limit for shift in shifts.values())
    injected = flip_shifts(shifts, 3, np.random.default_rng(2))
    assert injected.keys() == shifts.keys()
    assert bits_apart(injected, shifts) == 3


def test_numbers_that_the_board_could_not_store_are_refused(quantized: Quantized) -> None:
    op = quantized.core.convolutions[0]
    too_large = replace(op, bias=np.full(len(op.bias), 100_001))
    far = replace(
        op, weight_frac_bits=op.weight_frac_bits + 40, bias_frac_bits=op.bias_frac_bits + 40
    )
    for wrong in (too_large, far):
        with pytest.raises(ModelError, match=op.name):
            as_stored(with_ops(quantized.core, [wrong]))


def test_maps_have_the_channels_that_run(quantized: Quantized) -> None:
    tensors, _ = run_core(quantized.core, planes())
    assert {name: tensor.shape[1] for name, tensor in tensors.items()} == map_channels(
        quantized.core
    )


@pytest.fixture(scope="module")
def guards(core: IntCore) -> Guards:
    return learn_guards(core, [planes(seed) for seed in range(3)])


def test_calibration_patches_pass_untouched(core: IntCore, guards: Guards) -> None:
    for seed in range(3):
        bare, clamped = (
            run_core(core, planes(seed), faults=f)[0]
            for f in (NO_FAULTS, guarded(NO_FAULTS, guards))
        )
        assert_array_equal(bare[CORRECTION], clamped[CORRECTION])
        correction = merged_correction(core, bare)
        assert_array_equal(guards.limit(correction), correction)


def test_guards_take_the_smallest_bound_above_the_calibration_peak(core: IntCore) -> None:
    """Dark images stay below 96 units. Bright ones fill int8, and such a ReLU gets no bound."""
    dark = [planes(seed, 0.1) for seed in range(2)]
    guards = learn_guards(core, dark)
    runs = [run_core(core, each)[0] for each in dark]
    assert guards.relu6
    for name, bound in guards.relu6.items():
        peak = max(int(run[name].max()) for run in runs)
        assert bound in (96, 48, 24, 12, 6, 3)
        assert bound / 2 < max(peak, 2) <= max(bound, 2)
    largest = max(MAX_DN * float(np.abs(merged_correction(core, run)).max()) for run in runs)
    assert guards.limit_dn / 2 < largest <= guards.limit_dn


def test_a_clamped_result_keeps_its_bound_whatever_the_weights(core: IntCore) -> None:
    some = Guards(
        {op.output: 24 for op in core.convolutions if op.activation is Activation.relu}, 64.0, {}
    )
    injected = flip_weights(core, 2000, np.random.default_rng(0))
    bare, clamped = (
        run_core(injected, planes(9), faults=f)[0] for f in (NO_FAULTS, guarded(NO_FAULTS, some))
    )
    assert max(int(bare[name].max()) for name in some.relu6) > 24
    assert max(int(clamped[name].max()) for name in some.relu6) == 24
    limited = some.limit(merged_correction(core, clamped))
    bound = np.float32(64 / MAX_DN)
    assert np.abs(limited).max() <= bound < np.abs(merged_correction(core, bare)).max()


def test_faults_enter_memory_after_the_clamp(core: IntCore) -> None:
    name = next(op.output for op in core.convolutions if op.activation is Activation.relu)
    faults = Faults(
        {}, lambda target, tensor: np.full_like(tensor, 127) if target == name else tensor
    )
    tensors, _ = run_core(core, planes(), faults=guarded(faults, Guards({name: 3}, 1.0, {})))
    assert (tensors[name] == 127).all()


def test_every_single_flip_is_found_and_the_layer_scrubbed(core: IntCore, guards: Guards) -> None:
    generator = np.random.default_rng(3)
    for op in core.convolutions:
        for _ in range(8):
            injected = with_ops(core, [flip_conv(op, 1, generator)])
            wrong = {
                name for name, sum_ in checksums(injected).items() if sum_ != guards.checksums[name]
            }
            assert wrong == {op.name}
            assert checksums(scrubbed(injected, core, guards.checksums)) == guards.checksums


def test_voting_takes_the_majority_of_three_copies(core: IntCore) -> None:
    shifts = shifts_of(core)
    one, other = (flip_shifts(shifts, count, np.random.default_rng(count)) for count in (1, 4))
    assert one != shifts
    assert voted((one, shifts, shifts)) == shifts
    assert voted((shifts, one, shifts)) == voted((shifts, shifts, other)) == shifts
    # Triple modular redundancy cannot correct the same bit flipped in two copies.
    assert voted((one, one, shifts)) == one


def test_a_wrong_shift_is_used(core: IntCore) -> None:
    shifts = shifts_of(core)
    read = planes(2)
    faultless = run_core(core, read)[0][CORRECTION]
    assert_array_equal(run_core(core, read, faults=Faults(shifts))[0][CORRECTION], faultless)
    for key in (key for key in shifts if key[1] == "shift_cut"):
        for wrong in (-32, 31):
            assert not np.array_equal(
                run_core(core, read, faults=Faults({key: wrong}))[0][CORRECTION], faultless
            )


def test_extreme_shifts_keep_every_sign() -> None:
    """No value wraps around when the bias is shifted left by 31 and the sums by 32."""
    bias = np.array([57, 20, -3, 0], np.int8)
    op = IntConv("c", PLANES, CORRECTION, np.zeros((4, 1, 1, 1), np.int8), 0, bias, 0)
    core = IntCore((op,), {PLANES: 0, CORRECTION: 0})
    faults = Faults({("c", "shift_bias"): 31, ("c", "shift_cut"): -32})
    tensors, _ = run_core(core, np.zeros((1, 1, 1, 1), np.int8), faults=faults)
    assert tensors[CORRECTION].ravel().tolist() == [127, 127, -128, 0]
