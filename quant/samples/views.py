"""Define views: the ground that a simulated patch shows, its light, and the sensors that acquire
it.

Drawn scenes leave most of the sensor's range empty: 2 pixels in 100 000 lie above 0.7 of full
scale. A network that clips bright ground then passes the gate, and a network calibrated on them
does clip it. A stated share of the patches is therefore lit as on a dark day, up to full scale, and
beyond it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import TypeVar

import numpy as np

from beers_deploy.model.simulator.acquire import MARGIN_PX, scene_side_px
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.patches import PatchRecipe
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument

CANDIDATES = 8
"""The number of candidates that are drawn for each view."""
Candidate = TypeVar("Candidate")

DARK = (1 / 20, 1 / 4)
"""Factors on the radiance of patches lit as on a dark day, log-uniform between the two."""
BRIGHTEST_PIXELS = 0.999
"""The quantile of a bright patch that is placed near full scale."""
BRIGHT = (0.75, 1.0)
"""The range for that quantile, over full scale."""
SATURATED = (0.005, 0.05)
"""Share of the pixels of a saturated patch whose radiance exceeds full scale."""

Lightings = Mapping[str, float]
"""Ways to light the ground, and the share of the patches that are lit so."""

CALIBRATION: Lightings = {"as drawn": 13 / 16, "bright": 2 / 16, "dark": 1 / 16}
"""Up to full scale, but not beyond. At the edge of a saturated area the corrections of a network
are large and useless, because the result is clipped, and they make steps coarser everywhere. With a
sixteenth of saturated patches a DnCNN lost 0.2 dB more on photographs. With a quarter of bright and
an eighth of saturated ones a U-Net lost 0.41 dB instead of 0.17 (measured).
"""
JUDGING: Lightings = {
    "as drawn": 12 / 16,
    "bright": 2 / 16,
    "dark": 1 / 16,
    "saturated": 1 / 16,
}
"""The gate also covers the surroundings of saturated areas."""


@dataclass(frozen=True)
class Ground:
    """A square part of a scene that a patch shows, with a margin around it, at one scale and in one
    light.

    Scene pixels are those of the scene's own grid. Target pixels are those of the patch, each of
    which has several scene pixels a side.

    Attributes:
        scene: the scene that contains the square.
        top: the first row of the square in scene pixels.
        left: the first column of the square in scene pixels.
        side_px: the side of the square in target pixels.
        oversampling: the number of scene pixels per target pixel, along either side.
        exposure: the factor by which the scene's radiance is multiplied, which models more or less
            light.
    """

    scene: Scene
    top: int
    left: int
    side_px: int
    oversampling: int
    exposure: float

    @property
    def radiance(self) -> np.ndarray:
        """The radiance in W/m2/sr/um on the scene's grid, with side_px * oversampling pixels a
        side.
        """
        return self.exposure * self._part(1)

    @property
    def sampled_radiance(self) -> np.ndarray:
        """The radiance in W/m2/sr/um of one scene pixel for each target pixel."""
        return self.exposure * self._part(self.oversampling)

    @cached_property
    def brightness(self) -> float:
        """The mean radiance of the ground in W/m2/sr/um, estimated from `sampled_radiance`."""
        return float(self.sampled_radiance.mean())

    def _part(self, step: int) -> np.ndarray:
        side = self.side_px * self.oversampling
        return self.scene.radiance[
            self.top : self.top + side : step, self.left : self.left + side : step
        ]


@dataclass(frozen=True)
class View:
    """The ground that a simulated patch shows, and the two sensors that acquire it.

    Attributes:
        ground: the part of a scene, with its light.
        degraded: the sensor whose image the network restores.
        reference: the better sensor, whose image is the target.
    """

    ground: Ground
    degraded: Instrument
    reference: Instrument


def draw_views(
    scenes: Sequence[Scene], recipe: PatchRecipe, count: int, generator: np.random.Generator
) -> list[View]:
    """Draw the ground and the sensors of patches, spread over brightness, MTF and noise.

    The chance of a scene at a scale is proportional to the number of patches that it holds, as in
    training.

    Args:
        scenes: the scenes to draw from.
        recipe: the size of the patches, and the sensors, scales and light to draw from.
        count: the number of views.
        generator: the generator of all draws.

    Raises:
        ImageError: no scene is large enough for a patch.
    """
    places = _places(scenes, recipe)
    sides = [
        [size // ratio - 2 * MARGIN_PX for size in scene.radiance.shape] for scene, ratio in places
    ]
    room = np.prod(sides, axis=1)  # target pixels within the margin
    # One generator draws all of this, so the order of the draws must not change: it determines the
    # result of a seed.
    indices = generator.choice(len(places), CANDIDATES * count, p=room / room.sum())
    # A Fourier transform wraps around; the margin keeps the far border out of the patch.
    side_px = recipe.patch_px + 2 * MARGIN_PX
    grounds = []
    for k in indices:
        scene, ratio = places[k]
        top, left = (
            int(generator.integers(size - side_px * ratio + 1)) for size in scene.radiance.shape
        )
        exposure = float(generator.uniform(*recipe.looks.exposures))
        grounds.append(Ground(scene, top, left, side_px, ratio, exposure))
    source = recipe.family or recipe.degraded
    sensors = [source.draw(generator) for _ in range(CANDIDATES * count)]
    dark = recipe.degraded.radiance_0.low
    # Brightness, MTF and noise are each spread by themselves, in orders that do not depend on each
    # other.
    spread = zip(
        stratified(grounds, lambda ground: ground.brightness, count, generator),
        stratified(sensors, lambda sensor: sensor.mtf_nyquist, count, generator),
        stratified(sensors, lambda sensor: sensor.noise_sigma(dark), count, generator),
        strict=True,
    )
    views = []
    for ground, blurred, noisy in spread:
        # A view has the noise of one sensor and the blur of another, each from its own group.
        degraded = replace(
            noisy,
            mtf_nyquist=blurred.mtf_nyquist,
            mtf_nyquist_along=blurred.mtf_nyquist_along,
            response=blurred.response,
        )
        views.append(View(ground, degraded, recipe.reference.draw(generator)))
    return views


def stratified(
    candidates: Sequence[Candidate],
    key: Callable[[Candidate], float],
    count: int,
    generator: np.random.Generator,
) -> list[Candidate]:
    """Draw candidates such that they spread over a property: one from each of equally large groups.

    The groups are consecutive parts of the candidates sorted by the property. If `count` does not
    divide the number of candidates, the rest with the largest property is never drawn.

    Args:
        candidates: at least `count` items.
        key: returns the property by which the candidates are sorted.
        count: the number of groups.
        generator: the generator of the draws.

    Returns:
        One candidate of each group, in random order.
    """
    ranked = sorted(candidates, key=key)
    size = len(candidates) // count
    members = [ranked[group * size + int(generator.integers(size))] for group in range(count)]
    # In rank order the darkest ground would always meet the weakest MTF.
    return [members[k] for k in generator.permutation(count)]


def _places(scenes: Sequence[Scene], recipe: PatchRecipe) -> list[tuple[Scene, int]]:
    """Return scenes, each with every oversampling at which it holds a patch."""
    fitting = [
        (scene, ratio)
        for scene, ratio in product(scenes, recipe.oversamplings)
        if min(scene.radiance.shape) >= scene_side_px(recipe.patch_px, ratio)
    ]
    if not fitting:
        raise ImageError(
            "None of the calibration images is large enough for a patch of "
            f"{recipe.patch_px} target pixels and {MARGIN_PX} around it. Give larger images or a "
            "smaller patch."
        )
    return fitting


def relit(
    views: Sequence[View], lightings: Lightings, generator: np.random.Generator
) -> list[View]:
    """Multiply the light on the ground of some views, so that a stated share of them is bright,
    dark or saturated.

    Args:
        views: the views.
        lightings: the share of the views for each way of lighting, by its name as in `JUDGING`.
        generator: draws which views get which light, and the factors.

    Returns:
        The views with other exposures, in the same order.
    """
    assigned = assign_lightings(len(views), lightings, generator)
    result = []
    for view, lighting in zip(views, assigned, strict=True):
        sensor = view.degraded
        full_scale = (sensor.max_dn - sensor.offset_dn) / sensor.gain_dn_per_radiance
        factor = light_factor(lighting, view.ground.sampled_radiance, full_scale, generator)
        ground = replace(view.ground, exposure=factor * view.ground.exposure)
        result.append(replace(view, ground=ground))
    return result


def assign_lightings(count: int, lightings: Lightings, generator: np.random.Generator) -> list[str]:
    """Assign a way of lighting to each patch at random, such that each way gets its share of the
    patches.

    Args:
        count: the number of patches.
        lightings: the share of each way, by its name. The shares add up to 1.
        generator: draws the order.

    Returns:
        The name of the lighting of each patch.
    """
    names = list(lightings)
    # Each patch stands for the middle of an equal part of [0, 1], which rounds the shares to whole
    # patches.
    middles = (np.arange(count) + 0.5) / count
    numbers = np.searchsorted(np.cumsum(list(lightings.values())), middles)
    return [names[number] for number in generator.permutation(numbers)]


def light_factor(
    lighting: str, radiance: np.ndarray, full_scale: float, generator: np.random.Generator
) -> float:
    """Draw the factor by which ground is brightened or darkened for one way of lighting.

    Args:
        lighting: the way, a key of `JUDGING`.
        radiance: (h, w) the radiance of the ground, in W/m2/sr/um.
        full_scale: the radiance at which the sensor saturates, in W/m2/sr/um.
        generator: draws the random part.

    Returns:
        The factor on the radiance; 1 for ground without any light.
    """
    if lighting == "as drawn":
        return 1.0
    if lighting == "dark":
        # Uniform in the logarithm, so that each factor of two of the darkness is equally likely.
        return float(np.exp(generator.uniform(*np.log(DARK))))
    if lighting == "bright":
        brightest = float(np.quantile(radiance, BRIGHTEST_PIXELS))
        target = full_scale * generator.uniform(*BRIGHT)
    else:
        assert lighting == "saturated"  # noqa: S101 - there are no others
        brightest = float(np.quantile(radiance, 1 - generator.uniform(*SATURATED)))
        target = full_scale
    # No factor brightens ground without any light.
    return target / brightest if brightest > 0 else 1.0
