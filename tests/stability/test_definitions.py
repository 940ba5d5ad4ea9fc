"""Tests of SSIM, integer biases and MTF compensation against independent definitions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from numpy.testing import assert_array_equal

from beers_deploy.model.metrics.fidelity import SSIM_RADIUS_PX, SSIM_SIGMA_PX, ssim
from beers_deploy.model.simulator.mtf import mtf
from beers_deploy.model.traditional.compensate import compensation_gain
from beers_deploy.profiles.response import NYQUIST
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import board_model, host_model
from beers_deploy.quant.graph import CORRECTION, PLANES, PLANES_FRAC_BITS
from beers_deploy.quant.host_part import IMAGE_SLICES, DualRange
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.session import open_session, run
from beers_deploy.studies.stress.faults import with_ops
from tests.model.simulator.stages import with_contrast


def ssim_by_two_passes(image: np.ndarray, reference: np.ndarray, data_range: float) -> float:
    """Return SSIM with two-pass variances, which subtract no large numbers from each other."""
    offset = np.arange(-SSIM_RADIUS_PX, SSIM_RADIUS_PX + 1)
    side = np.exp(-0.5 * (offset / SSIM_SIGMA_PX) ** 2)
    weights = np.outer(side, side) / side.sum() ** 2
    x, y = (sliding_window_view(a.astype(np.float64), weights.shape) for a in (image, reference))
    mean_x, mean_y = ((a * weights).sum((2, 3)) for a in (x, y))
    from_x = x - mean_x[..., None, None]
    from_y = y - mean_y[..., None, None]
    var_x, var_y, both = (
        (a * b * weights).sum((2, 3))
        for a, b in ((from_x, from_x), (from_y, from_y), (from_x, from_y))
    )
    c1 = (0.01 * data_range) ** 2
    c2 = (0.03 * data_range) ** 2
    light = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    return float((light * (2 * both + c2) / (var_x + var_y + c2)).mean())


@settings(max_examples=20)
@given(
    seed=st.integers(0, 999),
    level=st.floats(0, 1),
    sigma=st.floats(1e-5, 0.01),
    data_range=st.sampled_from([1.0, 4095.0]),
)
def test_ssim_is_that_of_its_definition(
    seed: int, level: float, sigma: float, data_range: float
) -> None:
    noise = np.random.default_rng(seed).standard_normal((2, 23, 31))
    image, other = (data_range * (level + sigma * noise)).astype(np.float32)
    assert ssim(image, other, data_range) == pytest.approx(
        ssim_by_two_passes(image, other, data_range), abs=1e-12
    )


def biased(core: IntCore, generator: np.random.Generator) -> IntCore:
    """Return the core with random int8 biases, at random scales that the DPU can shift."""
    ops = []
    for op in core.convolutions:
        bias = generator.integers(-128, 128, len(op.bias)).astype(np.int8)
        product = op.weight_frac_bits + core.frac_bits[op.input]
        shift = int(generator.integers(0, 8))
        ops.append(replace(op, bias=bias, bias_frac_bits=product - shift))
    return with_ops(core, ops)


@pytest.mark.parametrize("shape", [(17, 20), (1, 1), (1, 19), (12, 2)])
@pytest.mark.parametrize("seed", [0, 1])
def test_both_files_hold_every_bias_at_its_scale(
    seed: int, shape: tuple[int, int], quantized: Quantized
) -> None:
    generator = np.random.default_rng(seed)
    core = biased(quantized.core, generator)
    image = generator.uniform(0.3, 0.7, (1, 1, *shape)).astype(np.float32)
    planes = IMAGE_SLICES.encode(image)
    scale = core.scale(CORRECTION)
    tensors, _ = run_core(core, planes, half_even=True)
    expected = tensors[CORRECTION] * np.float32(scale)
    restored = np.clip(image + DualRange().decode(expected, scale), 0, 1)
    assert_array_equal(run(open_session(host_model(core, {})), image), restored)
    feed = {PLANES: planes.astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)}
    assert_array_equal(open_session(board_model(core, {})).run(None, feed)[0], expected)


MTFS = st.floats(0.001, 0.63)


@given(mtf_from=MTFS, mtf_to=MTFS, epsilon=st.floats(1e-3, 1))
def test_no_inverse_amplifies_beyond_what_its_regularisation_proves(
    mtf_from: float, mtf_to: float, epsilon: float
) -> None:
    """T H / (H^2 + epsilon r^2) is at most T / (2 sqrt(epsilon) r), whatever the blur H."""
    gain = compensation_gain(32, 30, with_contrast(mtf_from), with_contrast(mtf_to), epsilon)
    fy = np.fft.fftfreq(32)[:, None]
    fx = np.fft.rfftfreq(30)
    radius = np.hypot(fy, fx) / NYQUIST
    assert float((gain * 2 * epsilon**0.5 * radius / mtf(fx, fy, mtf_to)).max()) <= 1 + 1e-9
