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

from beers_deploy.model.simulator.acquire import MARGIN_PX
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
    """A square of a scene, margin included, seen at one scale and in one light.

    Attributes:
        scene: it lies in.
        top: its first row in scene pixels.
        left: its first column.
        side_px: its rows and columns, in target pixels.
        oversampling: scene pixels per target pixel.
        exposure: factor on the scene's radiance.
    """

    scene: Scene
    top: int
    left: int
    side_px: int
    oversampling: int
    exposure: float

    @property
    def radiance(self) -> np.ndarray:
        """The radiance in W/m2/sr/um on the scene's grid: a square of side_px * oversampling."""
        return self.exposure * self._part(1)

    @property
    def sampled_radiance(self) -> np.ndarray:
        """One scene pixel for each target pixel, in W/m2/sr/um."""
        return self.exposure * self._part(self.oversampling)

    @cached_property
    def brightness(self) -> float:
        """Its mean radiance in W/m2/sr/um, estimated from `sampled_radiance`."""
        return float(self.sampled_radiance.mean())

    def _part(self, step: int) -> np.ndarray:
        side = self.side_px * self.oversampling
        return self.scene.radiance[
            self.top : self.top + side : step, self.left : self.left + side : step
        ]


@dataclass(frozen=True)
class View:
    """One patch: the ground, and the two sensors that see it."""

    ground: Ground
    degraded: Instrument
    reference: Instrument


def draw_views(
    scenes: Sequence[Scene], recipe: PatchRecipe, count: int, generator: np.random.Generator
) -> list[View]:
    """Draw `count` views, spread over brightness, MTF and noise.

    A scene at a scale is drawn as often as it holds patches, as training sees it.
    """
    places = _places(scenes, recipe)
    sides = [
        [size // ratio - 2 * MARGIN_PX for size in scene.radiance.shape] for scene, ratio in places
    ]
    room = np.prod(sides, axis=1)  # target pixels within the margin
    # One generator draws all of this, so the order of the draws must not change: it determines the
    # result of a seed.
    indices = generator.choice(len(places), CANDIDATES * count, p=room / room.sum())
    grounds = [_ground(places[k], recipe, generator) for k in indices]
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
    """Divide the candidates, sorted by `key`, into equal groups, and draw one of each.

    Args:
        candidates: at least `count` of them.
        key: by which they are sorted.
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
    side_px = recipe.patch_px + 2 * MARGIN_PX
    fitting = [
        (scene, ratio)
        for scene, ratio in product(scenes, recipe.oversamplings)
        if min(scene.radiance.shape) >= side_px * ratio
    ]
    if not fitting:
        raise ImageError(
            "None of the calibration images is large enough for a patch of "
            f"{recipe.patch_px} target pixels and {MARGIN_PX} around it. Give larger images or a "
            "smaller patch."
        )
    return fitting


def _ground(
    place: tuple[Scene, int], recipe: PatchRecipe, generator: np.random.Generator
) -> Ground:
    scene, oversampling = place
    # A Fourier transform wraps around; the margin keeps the far border out of the patch.
    side_px = recipe.patch_px + 2 * MARGIN_PX
    top, left = (
        int(generator.integers(size - side_px * oversampling + 1)) for size in scene.radiance.shape
    )
    exposure = float(generator.uniform(*recipe.looks.exposures))
    return Ground(scene, top, left, side_px, oversampling, exposure)


def relit(
    views: Sequence[View], lightings: Lightings, generator: np.random.Generator
) -> list[View]:
    """Return the views with other light: each share of them is lit as `lightings` states.

    Args:
        views: the ground of each is multiplied by a factor.
        lightings: the share of the views for each kind of light.
        generator: draws which views get which light, and the factors.
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
    """Assign a lighting to each of `count` patches at random, each in its share of the patches."""
    names = list(lightings)
    # Each patch stands for the middle of an equal part of [0, 1], which rounds the shares to whole
    # patches.
    middles = (np.arange(count) + 0.5) / count
    numbers = np.searchsorted(np.cumsum(list(lightings.values())), middles)
    return [names[number] for number in generator.permutation(numbers)]


def light_factor(
    lighting: str, radiance: np.ndarray, full_scale: float, generator: np.random.Generator
) -> float:
    """Return the factor on the radiance (h, w) that lights ground in one of the ways of `JUDGING`.

    Args:
        lighting: the way.
        radiance: the radiance of the ground, in W/m2/sr/um.
        full_scale: the radiance that the sensor's largest digital number stands for.
        generator: the generator of the random part.
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
