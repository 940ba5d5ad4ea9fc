"""One fused pass computes what the effects would, one after the other, at full resolution."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.simulator.mtf import mtf, smear_response, transfer_function
from model.simulator.sampling import sample, scene_spectrum

GAIN = 10.2375


def one_after_the_other(
    radiance: torch.Tensor, ratio: int, mtf_nyquist: float, sigma: float, smear: float
) -> torch.Tensor:
    """Blur, then smear, then shift, each with a transform of its own in float64; then pick every r-th pixel."""
    height, width = radiance.shape
    fy = torch.fft.fftfreq(height, 1 / ratio, dtype=torch.float64)[:, None]
    fx = torch.fft.rfftfreq(width, 1 / ratio, dtype=torch.float64)[None]
    shift = 2j * math.pi * (ratio - 1) / 2 / ratio
    image = radiance.double()
    for response in (
        mtf(fx, fy, mtf_nyquist, sigma),
        smear_response(fy, smear),
        torch.exp(shift * fy) * torch.exp(shift * fx),
    ):
        image = torch.fft.irfft2(torch.fft.rfft2(image) * response, s=(height, width))
    return image[::ratio, ::ratio]


@settings(max_examples=40)
@given(
    st.integers(1, 6), st.floats(0.01, 0.3), st.floats(0, 0.3), st.floats(0, 3),
    st.integers(10, 23), st.integers(10, 21), st.integers(0, 99),
)  # fmt: skip
def test_fused_equals_sequential(
    ratio: int, mtf_nyquist: float, sigma: float, smear: float, rows: int, columns: int, seed: int
) -> None:
    radiance = 300 * torch.rand(rows * ratio, columns * ratio, generator=torch.Generator().manual_seed(seed))
    transfer = transfer_function(*radiance.shape, ratio, mtf_nyquist, sigma, smear)
    fused = sample(scene_spectrum(radiance), transfer, radiance.shape[1], ratio)
    expected = one_after_the_other(radiance, ratio, mtf_nyquist, sigma, smear)
    assert float((fused - expected).abs().max()) * GAIN < 0.02


@pytest.mark.parametrize("mtf_nyquist", [0.01, 0.03, 0.05, 0.07, 0.25])
def test_a_slanted_edge_shows_the_mtf_of_the_profile(mtf_nyquist: float) -> None:
    """Contrast at Nyquist from the simulated edge, each row a copy shifted by a known sixteenth of a pixel."""
    ratio, side, rows = 16, 256, 16
    x = torch.arange(side * ratio, dtype=torch.float64)
    scene = torch.stack([torch.where(x < side * ratio / 2 + k, 40.0, 240.0) for k in range(rows)])
    scene = torch.cat([scene, scene.flip(1)], dim=1).float()  # the edge and its mirror: periodic without a jump
    transfer = torch.ones(rows, 1) * transfer_function(ratio, 2 * side * ratio, ratio, mtf_nyquist)[:1]
    lines = torch.fft.irfft(torch.fft.rfft(scene) * transfer, n=2 * side * ratio)[:, ratio // 2 :: ratio][:, :side]
    positions = torch.cat([torch.arange(side) * ratio - k for k in range(rows)])
    edge = torch.cat(list(lines))[positions.argsort()].double()
    line_spread = torch.diff(edge[side * rows // 4 : -side * rows // 4])
    spectrum = torch.fft.rfft(line_spread, n=64 * side * rows).abs()
    cycles_per_px = torch.arange(len(spectrum)) * rows / (64 * side * rows)
    measured = float(spectrum[int((cycles_per_px - 0.5).abs().argmin())] / spectrum[0])
    difference_filter = math.sin(math.pi * 0.5 / rows) / (math.pi * 0.5 / rows)
    assert measured / difference_filter == pytest.approx(mtf_nyquist, abs=0.005)
