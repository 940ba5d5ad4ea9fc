"""Guards: nothing changes in a fault-free network, and what they promise holds after an injection."""

import numpy as np
import pytest

from beers_deploy.profiles.sensor import MAX_DN
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, split
from beers_deploy.quant.integer.reference import SOUND, Faults, merged_correction, run_core
from beers_deploy.quant.quantise import Quantised
from beers_deploy.studies.stress.faults import (
    Guards,
    as_stored,
    checksums,
    flip_conv,
    flip_shifts,
    flip_weights,
    guarded,
    learn_guards,
    scrubbed,
    shifts_of,
    voted,
    with_ops,
)


def image(seed: int, height: int = 37, width: int = 53) -> np.ndarray:
    return np.random.default_rng(seed).random((1, 1, height, width), dtype=np.float32)


@pytest.fixture(scope="module")
def core(quantised: Quantised) -> IntCore:
    return as_stored(quantised.core)


@pytest.fixture(scope="module")
def guards(core: IntCore) -> Guards:
    return learn_guards(core, [split(image(seed)) for seed in range(3)])


def test_calibration_patches_pass_untouched(core: IntCore, guards: Guards) -> None:
    for seed in range(3):
        bare, clamped = (run_core(core, split(image(seed)), faults=f)[0] for f in (SOUND, guarded(SOUND, guards)))
        np.testing.assert_array_equal(bare[CORRECTION], clamped[CORRECTION])
        correction = merged_correction(core, bare)
        np.testing.assert_array_equal(guards.limit(correction), correction)


def test_bounds_are_the_next_ones_that_hold_what_was_seen(core: IntCore) -> None:
    """A dark image leaves room below 96 units; a bright one fills int8, and such a ReLU gets no bound."""
    dark = [split(0.1 * image(seed)) for seed in range(2)]
    guards = learn_guards(core, dark)
    runs = [run_core(core, planes)[0] for planes in dark]
    assert guards.relu6
    for name, bound in guards.relu6.items():
        peak = max(int(run[name].max()) for run in runs)
        assert bound in (96, 48, 24, 12, 6, 3)
        assert bound / 2 < max(peak, 2) <= max(bound, 2)
    largest = max(MAX_DN * float(np.abs(merged_correction(core, run)).max()) for run in runs)
    assert guards.limit_dn / 2 < largest <= guards.limit_dn


def test_a_clamped_result_keeps_its_bound_whatever_the_weights(core: IntCore) -> None:
    some = Guards(
        {op.output: 24 for op in core.ops if isinstance(op, IntConv) and op.activation is Activation.relu}, 64.0, {}
    )
    injected = flip_weights(core, 2000, np.random.default_rng(0))
    bare, clamped = (run_core(injected, split(image(9)), faults=f)[0] for f in (SOUND, guarded(SOUND, some)))
    assert max(int(bare[name].max()) for name in some.relu6) > 24
    assert max(int(clamped[name].max()) for name in some.relu6) == 24
    limited = some.limit(merged_correction(core, clamped))
    bound = np.float32(64 / MAX_DN)
    assert np.abs(limited).max() <= bound < np.abs(merged_correction(core, bare)).max()


def test_faults_enter_memory_after_the_clamp(core: IntCore) -> None:
    name = next(op.output for op in core.ops if isinstance(op, IntConv) and op.activation is Activation.relu)
    faults = Faults({}, lambda found, tensor: np.full_like(tensor, 127) if found == name else tensor)
    tensors, _ = run_core(core, split(image(0)), faults=guarded(faults, Guards({name: 3}, 1.0, {})))
    assert (tensors[name] == 127).all()


def test_every_single_flip_is_found_and_the_layer_scrubbed(core: IntCore, guards: Guards) -> None:
    generator = np.random.default_rng(3)
    for op in [op for op in core.ops if isinstance(op, IntConv)]:
        for _ in range(8):
            injected = with_ops(core, {op.name: flip_conv(op, 1, generator)})
            wrong = {name for name, sum_ in checksums(injected).items() if sum_ != guards.checksums[name]}
            assert wrong == {op.name}
            assert checksums(scrubbed(injected, core, guards.checksums)) == guards.checksums


def test_two_copies_of_three_decide(core: IntCore) -> None:
    meant = shifts_of(core)
    one, other = (flip_shifts(meant, count, np.random.default_rng(count)) for count in (1, 4))
    assert one != meant
    assert voted((one, meant, meant)) == meant
    assert voted((meant, one, meant)) == voted((meant, meant, other)) == meant
    assert voted((one, one, meant)) == one  # the same bit twice is beyond triple modular redundancy


def test_a_wrong_shift_is_used(core: IntCore) -> None:
    meant = shifts_of(core)
    planes = split(image(2))
    sound = run_core(core, planes)[0][CORRECTION]
    np.testing.assert_array_equal(run_core(core, planes, faults=Faults(meant))[0][CORRECTION], sound)
    for key in (key for key in meant if key[1] == "shift_cut"):
        for wrong in (-32, 31):
            assert not np.array_equal(run_core(core, planes, faults=Faults({key: wrong}))[0][CORRECTION], sound)


def test_shifts_as_wrong_as_can_be_keep_every_sign() -> None:
    """Nothing wraps around: bias moved left by 31, sums by 32."""
    bias = np.array([57, 20, -3, 0], np.int8)
    op = IntConv("c", PLANES, CORRECTION, np.zeros((4, 1, 1, 1), np.int8), 0, bias, 0)
    core = IntCore((op,), {PLANES: 0, CORRECTION: 0})
    faults = Faults({("c", "shift_bias"): 31, ("c", "shift_cut"): -32})
    tensors, _ = run_core(core, np.zeros((1, 1, 1, 1), np.int8), faults=faults)
    assert tensors[CORRECTION].ravel().tolist() == [127, 127, -128, 0]
