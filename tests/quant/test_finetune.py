"""Tests that fine-tuning the integers comes nearer to the target, is never worse, stays legal."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from beers_deploy.model.progress import Step, progress, reporting
from beers_deploy.profiles.errors import ImageError
from beers_deploy.quant.core import IntCore, build_core, shift_faults
from beers_deploy.quant.graph import (
    PLANES,
    Shuffle,
    correction_graph,
    read_planes,
)
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.integer.trainable import TrainableCore
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.passes.finetune import BORDER_PX, Sample, Tuning, finetune
from beers_deploy.quant.passes.scales import moved as moved_tensors
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.studies.stress.faults import with_ops
from tests.quant.quick import quickly, without_references
from tests.quant.trained import assert_equals_reference, moved, odd_operations


def corrupted(core: IntCore) -> IntCore:
    """Return a core whose weights are off by a few units."""
    generator = np.random.default_rng(5)
    ops = []
    for op in core.convolutions:
        weight = op.weight + generator.integers(-4, 5, op.weight.shape)
        ops.append(replace(op, weight=np.clip(weight, -128, 127).astype(np.int8)))
    return with_ops(core, ops)


def correction(core: IntCore, degraded: np.ndarray) -> np.ndarray:
    """Return the correction that the integers of a core compute for an image."""
    planes = core.host_part.encode(degraded)
    tensors, _ = run_core(core, planes)
    return merged_correction(core, tensors)


def trained(core: IntCore, model: onnx.ModelProto, tuning: Tuning) -> IntCore:
    """Return the core after fine-tuning."""
    return finetune(core, read_planes(correction_graph(model)), tuning)[0]


def difference(core: IntCore, other: IntCore, patches: Patches) -> float:
    """Return the mean squared difference between two cores' corrections."""
    return error(core, [(image, correction(other, image)) for image in patches.degraded])


def error(core: IntCore, targets: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the mean squared difference between corrections of images and expected ones."""
    errors = [np.square(correction(core, image) - expected).mean() for image, expected in targets]
    return float(np.mean(errors))


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_odd_operations_equal_the_reference(seed: int) -> None:
    """Training computes odd shapes and scales as the integer reference does.

    A difference would train another network than the one that runs on the board.
    """
    generator = np.random.default_rng(seed)
    graph = odd_operations(generator)
    bits = {op.output: int(generator.integers(4, 7)) for op in graph} | {PLANES: 7}
    core = build_core(graph, bits)
    assert_equals_reference(
        moved(core), generator.integers(-128, 128, (1, 3, 12, 10)).astype(np.int8)
    )


@pytest.mark.slow
def test_without_references_it_comes_back_towards_the_float_network(
    quantized: Quantized, float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches
) -> None:
    """Weights that are off come back towards the float network, on images that were not trained
    on.
    """
    bad = corrupted(quantized.core)
    tuned = trained(bad, float_onnx, Tuning(without_references(patches).pairs, 40, rate=0.1))
    assert difference(tuned, quantized.core, unseen) < 0.7 * difference(bad, quantized.core, unseen)
    assert shift_faults(tuned) == []


@pytest.mark.slow
def test_moved_scales_improve_unseen_images_and_are_counted(
    float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches
) -> None:
    """Scales that are a bit too coarse are moved and counted, which improves unseen images."""
    # All tensors are one bit too coarse.
    plain = quickly(float_onnx, patches)
    bits = {name: n - (name != PLANES) for name, n in plain.core.frac_bits.items()}
    coarse = build_core(plain.graph, bits, host_part=plain.core.host_part)
    tuned = trained(coarse, float_onnx, Tuning(without_references(patches).pairs, 1, rate=0.0))
    assert moved_tensors(coarse, tuned) > 0
    assert shift_faults(tuned) == []
    before = difference(coarse, plain.core, unseen)
    after = difference(tuned, plain.core, unseen)
    assert after < 0.8 * before


@pytest.fixture
def no_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep all scales, because moving them may gain by itself."""
    name = "beers_deploy.quant.passes.finetune.with_better_scales"
    monkeypatch.setattr(name, lambda trainable, *_: trainable)


@pytest.mark.usefixtures("no_moves")
def test_a_worse_result_is_discarded(
    quantized: Quantized, float_onnx: onnx.ModelProto, patches: Patches
) -> None:
    """Training at an absurd rate returns the core unchanged: it is never made worse."""
    tuned = trained(
        quantized.core, float_onnx, Tuning(without_references(patches).pairs, 2, rate=60.0)
    )
    assert tuned is quantized.core


@pytest.mark.usefixtures("no_moves")
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_it_trains_where_the_caller_has_switched_gradients_off(
    quantized: Quantized,
    float_onnx: onnx.ModelProto,
    patches: Patches,
    mode: type[torch.no_grad | torch.inference_mode],
) -> None:
    graph = read_planes(correction_graph(float_onnx))
    with mode():
        _, steps = finetune(quantized.core, graph, Tuning([patches.pairs[0]], 1))
    assert steps == 1


@pytest.mark.usefixtures("no_moves")
@pytest.mark.parametrize(("rate", "steps"), [(0.0, 44), (0.1, 46)])
def test_it_goes_on_by_itself_while_held_out_pairs_gain(
    quantized: Quantized,
    float_onnx: onnx.ModelProto,
    patches: Patches,
    monkeypatch: pytest.MonkeyPatch,
    rate: float,
    steps: int,
) -> None:
    """Without a number of steps it goes on while held-out pairs gain, and stops when they gain at
    none of three paces.
    """
    monkeypatch.setattr("beers_deploy.quant.passes.finetune.ROUNDS", (40, 2, 2, 2))
    monkeypatch.setattr("beers_deploy.quant.passes.finetune.BATCH_PIXELS", 48**2)
    graph = read_planes(correction_graph(float_onnx))
    small = [
        (image[..., :48, :48], nothing) for image, nothing in without_references(patches).pairs
    ]
    assert finetune(corrupted(quantized.core), graph, Tuning(small, None, rate))[1] == steps


def test_a_reference_of_another_size_is_refused_in_one_sentence(
    quantized: Quantized, float_onnx: onnx.ModelProto, patches: Patches
) -> None:
    """A reference that does not fit its image is refused with both sizes."""
    degraded, reference = patches.pairs[0]
    short = [(degraded, reference[..., :-2])] * 2
    with pytest.raises(
        ImageError, match=r"reference has the size 1 x 1 x 128 x 126, but .* 1 x 1 x 128 x 128"
    ):
        trained(quantized.core, float_onnx, Tuning(short, 1))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(
    float_onnx: onnx.ModelProto, patches: Patches
) -> None:
    """Two runs of one seed write the same bytes, and report their steps."""

    def file_bytes(seed: int) -> bytes:
        """Quantize and fine-tune, and return the file."""
        reported: list[Step] = []
        tuning = Tuning(patches.pairs, 3, rate=0.3, seed=seed)
        with reporting(reported.append), progress("calibrating"):
            model = quantize_model(float_onnx, patches, {}, tuning=tuning)
        assert reported[-1].what.startswith("calibrating: fine-tuning, step 3 of 3: ")
        record = metadata(model.host)["finetune"]
        assert record.startswith(f"3 steps on {len(patches.pairs)} patches, scales of ")
        return bytes(model.host.SerializeToString())

    assert file_bytes(1) == file_bytes(1)


@pytest.mark.parametrize(
    ("side", "is_compared"), [(4 * BORDER_PX, False), (4 * BORDER_PX - 1, True)]
)
def test_the_target_at_the_border_is_the_float_network(side: int, is_compared: bool) -> None:
    """At the border of a patch the float network is the target, because the reference depends on
    pixels outside of it.

    Small patches are an exception, as little would be left of them.
    """
    inner = torch.rand((1, 1, side, side + 9), generator=torch.Generator().manual_seed(1))
    edge = inner.clone()
    edge[..., 0, :] += 1
    image = inner.numpy()
    assert (float(Sample(image, inner, inner, edge, 1.0).error(inner)) > 0) is is_compared
    assert float(Sample(image, inner, edge, inner, 1.0).error(inner)) > 0


def test_gradients_pass_roundings_and_stop_where_int8_clips(
    quantized: Quantized, patches: Patches
) -> None:
    """Every layer gets a gradient through its roundings, and weights that are clipped get none."""
    trainable = TrainableCore(quantized.core)
    encoded = quantized.core.host_part.encode(patches.degraded[0])
    planes = torch.from_numpy(encoded.astype(np.float32))
    trainable(planes).square().mean().backward()
    assert all(bool(weight.grad.abs().max() > 0) for weight in trainable.weights)
    with torch.no_grad():
        # INT8 ends at 127, so these weights are clipped and get no gradient.
        trainable.weights[0].fill_(200.0)
    trainable.zero_grad()
    trainable(planes).square().mean().backward()
    assert float(trainable.weights[0].grad.abs().max()) == 0


@given(
    backs=st.lists(st.tuples(st.integers(1, 3), st.booleans()), max_size=2),
    adds=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_correction_of_a_result_gives_that_result(
    backs: list[tuple[int, bool]], adds: bool, seed: int
) -> None:
    """The correction that is computed from a target gives that target, through any shuffles."""
    generator = np.random.default_rng(seed)
    back = tuple(
        Shuffle(f"s{k}", "a", "b", block, True, order) for k, (block, order) in enumerate(backs)
    )
    host_part = HostPart(back=back, adds_image=adds)
    image, result = (generator.random((1, 1, 36, 72)).astype(np.float32) for _ in range(2))
    result_again = host_part.finish(image, host_part.correction_of(image, result))
    assert_allclose(result_again, result, atol=2e-7)


@pytest.mark.slow
def test_training_on_references_improves_unseen_images(
    quantized: Quantized, float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches
) -> None:
    """Training on references restores unseen images better than the network before."""
    tuned = trained(quantized.core, float_onnx, Tuning(patches.pairs, 20, rate=0.3))
    part = quantized.core.host_part
    targets = [(image, part.correction_of(image, result)) for image, result in unseen.pairs]
    assert error(tuned, targets) < 0.97 * error(quantized.core, targets)
