"""Simulate one scene acquired by one or two sensors: blur, sampling, then the steps of `detector`
in order.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from beers_deploy.model.simulator.detector import Draw, Pixels, detect
from beers_deploy.model.simulator.mtf import sensor_transfer
from beers_deploy.model.simulator.plan import Plan, SceneStats, scene_stats
from beers_deploy.model.simulator.sampling import crop_divisible, sample, scene_spectrum
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument

MARGIN_PX = 32
"""Target pixels cropped on each side, because the FFT wraps around and the tail of the PSF is long
(10.8 DN at 32).
"""
LEAST_SIDE_PX = 48
"""The least side in target pixels, without margins, that evaluation and validation need."""
NOISE = ("noise", "digitising")
"""Steps that are skipped for an acquisition without noise: that of the light and the detector, and
rounding.
"""


@dataclass(frozen=True)
class Pair:
    """Two acquisitions of one scene, (..., H, W) float32 that hold integer digital numbers."""

    degraded: np.ndarray
    reference: np.ndarray


@dataclass(frozen=True)
class PreparedScene:
    """A scene, with its spectrum and statistics, which are computed once for several sensors."""

    radiance: np.ndarray
    oversampling: int

    @cached_property
    def stats(self) -> SceneStats:
        """Statistics of the scene that the plan of effects needs."""
        return scene_stats(self.radiance, self.oversampling)

    @cached_property
    def spectrum(self) -> np.ndarray:
        """Half spectrum (..., H, W // 2 + 1) of the scene, computed when it is first needed."""
        return scene_spectrum(self.radiance)


def prepare_scene(radiance: np.ndarray, oversampling: int) -> PreparedScene:
    """Crop a scene for sensors that see `oversampling` x `oversampling` of its pixels as one.

    Args:
        radiance: the radiance (..., H, W) of the scene in W/m2/sr/um.
        oversampling: the number of scene pixels per pixel of a sensor, along each side. The sides
            of the scene become multiples of it.
    """
    return PreparedScene(crop_divisible(radiance, oversampling), oversampling)


def simulate_planned(
    scene: PreparedScene,
    sensor: Instrument,
    draw: Draw,
    plan: Plan,
    role: str = "degraded",
    margin_px: int = MARGIN_PX,
) -> np.ndarray:
    """Simulate a scene with only the effects that its plan applies.

    Args:
        scene: the prepared scene (H, W).
        sensor: the instrument.
        draw: seed and patch number of the random effects.
        plan: the decision for each effect.
        role: "degraded" or "reference"; keeps the two noises of a pair independent.
        margin_px: the number of pixels of the image that are cropped on each side.

    Returns:
        Digital numbers (H / r - 2 margin, W / r - 2 margin).
    """
    if "mtf" not in plan.skipped:
        instrument = without(sensor, plan.skipped)
        return acquire(scene, instrument, draw, role, margin_px=margin_px, skip=plan.skipped)
    # Without any blur a target pixel is the mean of its scene pixels, which needs no transform.
    ratio = scene.oversampling
    height, width = scene.radiance.shape
    pixels = scene.radiance.reshape(height // ratio, ratio, width // ratio, ratio).mean((1, 3))
    return detect(crop_margin(pixels, margin_px), sensor, draw, role, plan.skipped)


def without(sensor: Instrument, skipped: Collection[str]) -> Instrument:
    """Return the sensor without the effects in `skipped`."""
    return replace(sensor, effects={k: v for k, v in sensor.effects.items() if k not in skipped})


def simulate_pair(
    radiance: np.ndarray,
    degraded: Instrument,
    reference: Instrument,
    oversampling: int,
    draw: Draw,
) -> Pair:
    """Simulate two acquisitions of a scene (..., H, W) in W/m2/sr/um, each with its own noise.

    Args:
        radiance: the scene.
        degraded: the sensor of the first image.
        reference: the sensor of the second image.
        oversampling: r, the number of scene pixels per pixel of the sensors, along each side.
        draw: seed and patch number of the random effects.

    Returns:
        The pair, each (..., H / r - 2 MARGIN_PX, W / r - 2 MARGIN_PX).
    """
    scene = prepare_scene(radiance, oversampling)
    return Pair(
        acquire(scene, degraded, draw),
        acquire(scene, reference, draw, "reference"),
    )


def acquire(
    scene: PreparedScene,
    sensor: Instrument,
    draw: Draw,
    role: str = "degraded",
    margin_px: int = MARGIN_PX,
    skip: Collection[str] = (),
) -> np.ndarray:
    """Simulate one acquisition: blur and sampling, then `detect` on the target grid.

    Args:
        scene: the prepared scene (..., H, W).
        sensor: the instrument.
        draw: seed and patch number of the random effects.
        role: "degraded" or "reference"; keeps the two noises of a pair independent.
        margin_px: the number of pixels of the image that are cropped on each side.
        skip: the names of effects that `detect` leaves out.

    Returns:
        Digital numbers (h, w).
    """
    ratio = scene.oversampling
    height, width = scene.radiance.shape[-2:]
    transfer = sensor_transfer(height, width, ratio, sensor)
    # The transform wraps around: without a margin the far border leaks into the near one.
    signal = crop_margin(sample(scene.spectrum, transfer, width, ratio), margin_px)
    return detect(signal, sensor, draw, role, skip)


def acquire_three(
    scene: PreparedScene, degraded: Instrument, reference: Instrument, draw: Draw
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate a pair of one scene, and the reference once more without noise and rounding.

    Returns:
        The degraded image, the reference, and the reference without noise: digital numbers (h, w)
        each.
    """
    return (
        acquire(scene, degraded, draw),
        acquire(scene, reference, draw, "reference"),
        acquire(scene, reference, draw, "reference", skip=NOISE),
    )


def acquire_padded(
    radiance: np.ndarray, sensor: Instrument, oversampling: int, draw: Draw, role: str
) -> np.ndarray:
    """Simulate the acquisition of a whole scene, whose margin is its mirror image.

    Pixel n covers scene pixels r n to r n + r - 1, where r is `oversampling`. A position x of the
    scene is mapped to x / r, if pixel i covers i to i + 1.

    Args:
        radiance: the scene (H, W) in W/m2/sr/um.
        sensor: the instrument.
        oversampling: the number of scene pixels per pixel of the sensor, along each side.
        draw: seed and patch number of the random effects.
        role: "degraded" or "reference"; keeps the two noises of a pair independent.

    Returns:
        Digital numbers (ceil(H / r), ceil(W / r)).
    """
    margin_px = MARGIN_PX * oversampling
    # The last target pixel may lack scene pixels: size % -oversampling is minus their number.
    after = [margin_px - size % -oversampling for size in radiance.shape]
    padded = np.pad(radiance, [(margin_px, end_px) for end_px in after], mode="reflect")
    return acquire(prepare_scene(padded, oversampling), sensor, draw, role)


def fitting_oversampling(
    radiance: np.ndarray, oversamplings: Iterable[int], side_px: int
) -> int | None:
    """Return the first oversampling that leaves `side_px` target pixels within the margin, or None.

    Args:
        radiance: the scene (H, W).
        oversamplings: the candidates, in order of preference.
        side_px: the smallest side, in pixels, that an image must keep within its margins.
    """
    shorter_px = min(radiance.shape)
    return next((r for r in oversamplings if scene_side_px(side_px, r) <= shorter_px), None)


def scene_side_px(side_px: int, oversampling: int) -> int:
    """Return the side in scene pixels of a scene from which an image of a side is simulated.

    Args:
        side_px: the side of the image, in pixels.
        oversampling: the number of scene pixels per pixel of the image, along each side.
    """
    return (side_px + 2 * MARGIN_PX) * oversampling


def crop_margin(image: Pixels, margin_px: int) -> Pixels:
    """Cut `margin_px` pixels from every side of images (..., H, W), arrays or tensors.

    Raises:
        ImageError: nothing would be left of the images.
    """
    height, width = image.shape[-2:]
    if min(height, width) <= 2 * margin_px:
        raise ImageError(
            f"The scene must have more than {2 * margin_px} target pixels a side, which is the "
            f"margin for the blur, but it has {width} x {height}. Give a larger scene or a smaller "
            "oversampling."
        )
    return image[..., margin_px : height - margin_px, margin_px : width - margin_px]
