"""Vary how the ground looks in a pass: its light, contrast and softness.

Aerial photographs are bright, sharp and rich in contrast, more than most satellite images. A
network that learns from them only restores dark, hazy and soft ground worse than it could.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, with_config

from beers_deploy.model.simulator.chart import log_uniform
from beers_deploy.profiles.validation import CONFIG, Amount, Share


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"must have its lower end first, got {list(ends)}. Swap the two.")
    return ends


Range = Annotated[tuple[Amount, Amount], AfterValidator(_ordered)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
LogRange = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]


@dataclass(frozen=True)
class Look:
    """The appearance of a scene in one acquisition: its light, contrast and softness.

    Attributes:
        light: a factor on the radiance of the scene.
        contrast: the share that is left of the contrast around the mean of the scene.
        softness_px: the standard deviation of a Gaussian by which the ground itself is blurred, in
            pixels of the images; 0 for no blur.
    """

    light: float
    contrast: float = 1.0
    softness_px: float = 0.0


@with_config(CONFIG)
@dataclass(frozen=True)
class Looks:
    """The distribution from which a training draws the look of each pass over a scene.

    Attributes:
        exposures: the range of the light of ordinary passes, as a factor on the photograph's; drawn
            uniformly.
        lit_share: the share of the passes whose light is drawn from `lights` instead.
        lights: the range of this factor, from deep shade to saturated areas; drawn log-uniformly.
        calm_share: the share of the passes with reduced contrast.
        contrasts: the range of the share of contrast that is left in them; drawn log-uniformly.
        soft_share: the share of the passes over ground that is blurred further.
        softness_px: the range of the standard deviation of that blur, in pixels of the images;
            drawn uniformly.
    """

    exposures: Range = (0.5, 1.25)
    lit_share: Share = 0.0
    lights: LogRange = (0.03, 2.5)
    calm_share: Share = 0.0
    contrasts: LogRange = (0.05, 1.0)
    soft_share: Share = 0.0
    softness_px: Range = (0.3, 1.5)

    def draw(self, generator: np.random.Generator) -> Look:
        """Draw the look of one pass."""
        light = float(generator.uniform(*self.exposures))
        contrast = 1.0
        softness_px = 0.0
        if generator.random() < self.lit_share:
            light = log_uniform(generator, self.lights)
        if generator.random() < self.calm_share:
            contrast = log_uniform(generator, self.contrasts)
        if generator.random() < self.soft_share:
            softness_px = float(generator.uniform(*self.softness_px))
        return Look(light, contrast, softness_px)


ORDINARY = Looks()
"""Unchanged photographs, on days of different light."""
