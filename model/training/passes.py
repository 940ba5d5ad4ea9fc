"""Simulate one pass of two sensors over a scene in torch, so that it can run on a GPU.

The physics is that of `model.simulator`: blur and sampling by FFT, then the detector. The spectrum
of a scene is computed once, and each pass blurs, samples and folds it again. Random numbers of a
pass come from a NumPy generator. Only the noise comes from torch's generator, whose numbers differ
between a CPU and a GPU.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from beers_deploy.model.simulator import detector
from beers_deploy.model.simulator.acquire import crop_margin
from beers_deploy.model.simulator.detector import NOISE_LIMIT, Draw
from beers_deploy.model.simulator.mtf import Blur, gamma_from_mtf, transfer_function
from beers_deploy.model.simulator.sampling import Scene, crop_divisible
from beers_deploy.model.training.looks import Look
from beers_deploy.profiles.effects import pixel_effects
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import MtfTable, PointSpread

GAMMAS = 513
"""The number of radii at which a table's gamma is known. It is interpolated between them, with an
error of 1e-4 at most.
"""


@dataclass(frozen=True)
class Visited:
    """A scene with its Fourier transform, which all acquisitions of a pass share.

    Attributes:
        spectrum: the half spectrum of its radiance, (H, W // 2 + 1) complex64.
        width: the width W of the scene in pixels.
    """

    spectrum: Tensor
    width: int

    @property
    def sides(self) -> tuple[int, int]:
        """The number of rows and columns of the scene."""
        return self.spectrum.shape[0], self.width


@dataclass(frozen=True)
class Pass:
    """One simulated flight over a scene: the parameters that the degraded and the reference
    acquisition share.

    Attributes:
        oversampling: the number of scene pixels per pixel of the images, along each side.
        phase_px: the shift (down, right) of the sampling grid in scene pixels. Both have the same,
            because a restoration must not shift the image.
        look: the look of the ground.
        margin_px: the number of pixels of the images that are cropped on each side.
    """

    oversampling: int
    phase_px: tuple[float, float]
    look: Look
    margin_px: int


def prepare(scene: Scene, multiple: int, device: torch.device | str = "cpu") -> Visited:
    """Crop a scene so that `multiple` divides its sides, and compute its spectrum.

    Raises:
        ImageError: the scene is smaller than `multiple`.
    """
    height, width = scene.radiance.shape
    if min(height, width) < multiple:
        raise ImageError(
            f"{scene.name} must have at least {multiple} pixels a side to train on, but it has "
            f"{width} x {height}. Leave it out."
        )
    radiance = np.ascontiguousarray(crop_divisible(scene.radiance, multiple))
    return Visited(torch.fft.rfft2(torch.from_numpy(radiance).to(device)), radiance.shape[-1])


def folded_signals(scene: Visited, sensors: tuple[Instrument, ...], passage: Pass) -> list[Tensor]:
    """Compute the radiance that each sensor samples in one pass over a scene: blurred, but without
    noise.

    Args:
        scene: the scene and its spectrum.
        sensors: the instruments, such as the degraded one and the reference.
        passage: the parameters of the pass.

    Returns:
        For each instrument the radiance (h, w) at its pixels, without the margin.
    """
    height, width = scene.sides
    device = scene.spectrum.device
    down, across = frequencies(height, width, passage.oversampling, device)
    ground = with_look(scene.spectrum, passage.look, down, across)
    # Target pixel n is sampled at the centre of its scene pixels, as
    # `model.simulator.sampling.sample` does.
    centre = (passage.oversampling - 1) / 2
    ground *= _ramp(down / passage.oversampling, centre + passage.phase_px[0])[:, None]
    ramp = _ramp(across / passage.oversampling, centre + passage.phase_px[1]) / passage.oversampling
    signals = []
    for sensor in sensors:
        blurs = sensor.blur, sensor.antialias_px, sensor.smear_px
        transfer = transfer_of(height, width, passage.oversampling, *blurs, str(device))
        # Keeping every r-th row is adding up the r aliases of each frequency: what follows is r
        # times smaller.
        aliases = (ground * transfer).view(passage.oversampling, height // passage.oversampling, -1)
        rows = aliases.sum(0) * ramp
        lines = torch.fft.irfft(torch.fft.ifft(rows, dim=0), n=width)
        signals.append(crop_margin(lines[:, :: passage.oversampling], passage.margin_px))
    return signals


def with_look(spectrum: Tensor, look: Look, fy: Tensor, fx: Tensor) -> Tensor:
    """Apply a look to the half spectrum of the ground; its mean changes with the light only.

    Args:
        spectrum: (H, W // 2 + 1) complex.
        look: the light, contrast and softness to apply.
        fy: vertical frequencies (H,) in cycles per pixel of the images.
        fx: horizontal frequencies (W // 2 + 1,) in the same unit.

    Returns:
        The changed half spectrum, (H, W // 2 + 1) complex.
    """
    ground = spectrum * (look.light * look.contrast)
    if look.softness_px:
        down, across = (torch.exp(-2 * (math.pi * look.softness_px * f) ** 2) for f in (fy, fx))
        ground *= down[:, None]
        ground *= across
    # Frequency 0 is the mean of the ground, which the light alone changes.
    ground[0, 0] = spectrum[0, 0] * look.light
    return ground


def _ramp(frequency: Tensor, shift_px: float) -> Tensor:
    angle = 2 * math.pi * shift_px * frequency
    return torch.polar(torch.ones_like(angle), angle)


def frequencies(
    height: int, width: int, oversampling: int, device: torch.device | str
) -> tuple[Tensor, Tensor]:
    """Return the vertical (H,) and horizontal (W // 2 + 1,) frequencies of a half spectrum.

    They are in cycles per pixel of the sensor, of which each is `oversampling` samples of the grid
    of `height` x `width` wide.
    """
    down = torch.fft.fftfreq(height, 1 / oversampling, device=device)
    return down, torch.fft.rfftfreq(width, 1 / oversampling, device=device)


@lru_cache(maxsize=32)
def transfer_of(
    height: int,
    width: int,
    oversampling: int,
    blur: Blur,
    antialias_px: float,
    smear_px: float,
    device: str,
) -> Tensor:
    """Compute `model.simulator.mtf.transfer_function` on a device, (H, W // 2 + 1) float32.

    A point-spread function is passed to that function, and its result is complex64.
    """
    if isinstance(blur, PointSpread):
        transfer = transfer_function(height, width, oversampling, blur, antialias_px, smear_px)
        return torch.from_numpy(transfer).to(device)
    down, across = frequencies(height, width, oversampling, device)
    fy = down[: height // 2 + 1, None].abs()
    fx = across[None]
    radius = torch.hypot(fy, fx)
    if isinstance(blur, MtfTable):
        # Gamma is interpolated at each radius, as `MtfTable.at` does. The last radius has no
        # neighbour on its right.
        evenly = np.linspace(blur.frequency[1], blur.frequency[-1], GAMMAS)
        scale = (GAMMAS - 1) / (evenly[-1] - evenly[0])
        place = (radius.clamp(evenly[0], evenly[-1]) - evenly[0]) * scale
        left = place.int().clamp(max=GAMMAS - 2)
        tables = (torch.tensor(v, dtype=torch.float32).to(device) for v in blur.gammas(evenly))
        gamma_x, gamma_y = (torch.lerp(v[left], v[left + 1], place - left) for v in tables)
        loss = torch.hypot(gamma_x * fx, gamma_y * fy)
    else:
        axes = blur if isinstance(blur, tuple) else (blur, blur)
        across_gamma, along_gamma = (gamma_from_mtf(contrast, antialias_px) for contrast in axes)
        loss = torch.hypot(across_gamma * fx, along_gamma * fy)
    # The anti-alias filter's own loss: exp(-2 pi^2 sigma^2 f^2).
    loss = loss + 2 * (math.pi * antialias_px * radius) ** 2
    upper = torch.exp(-loss) * torch.sinc(fx) * (torch.sinc(fy) * torch.sinc(smear_px * fy))
    # The transfer is even in fy: the rows below mirror those above.
    return torch.cat([upper, upper[1 : (height + 1) // 2].flip(0)])


def detected(
    signal: Tensor, sensor: Instrument, role: str, generator: np.random.Generator
) -> Tensor:
    """Simulate the detector for a sampled signal (h, w), and return digital numbers over full
    scale.

    Args:
        signal: radiance in W/m2/sr/um.
        sensor: the instrument.
        role: "degraded" or "reference", so that the two draws of a pair differ.
        generator: the generator of the seed of the noise.
    """
    seed = int(generator.integers(2**31))
    if any(pixel_effects(sensor.effects, acts_on) for acts_on in ("radiance", "DN")):
        acquired = detector.detect(signal.cpu().numpy(), sensor, Draw(seed), role)
        return torch.from_numpy(np.asarray(acquired / sensor.max_dn, np.float32)).to(signal.device)
    noise = torch.empty_like(signal)
    noise.normal_(generator=torch.Generator(signal.device).manual_seed(seed)).clamp_(
        -NOISE_LIMIT, NOISE_LIMIT
    )
    sigma = (sensor.alpha * signal.clamp(min=0) + sensor.beta).clamp(min=0).sqrt()
    dn = (signal + sigma * noise) * sensor.gain_dn_per_radiance
    return dn.round().clamp(0, sensor.max_dn) / sensor.max_dn


def noiseless(signal: Tensor, sensor: Instrument) -> Tensor:
    """Simulate the detector as `detected` does, without noise and rounding."""
    dn = signal * sensor.gain_dn_per_radiance + sensor.offset_dn
    return dn.clamp(0, sensor.max_dn) / sensor.max_dn
