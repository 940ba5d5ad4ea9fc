"""Vary how the ground looks in a pass: its light, contrast and softness.

Aerial photographs are bright, sharp and rich in contrast, more than most satellite images. A
network that learns from them only restores dark, hazy and soft ground worse than it could.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import with_config

from beers_deploy.model.simulator.chart import log_uniform
from beers_deploy.profiles.validation import CONFIG, Amount

Range = tuple[Amount, Amount]


@dataclass(frozen=True)
class Look:
    """The appearance of a scene in one acquisition: its light, contrast and softness.

    Attributes:
        light: factor on the scene's radiance.
        contrast: share of the contrast around the scene's mean that is left.
        softness_px: standard deviation of a further blur of the ground, in target pixels; 0 is
            none.
    """

    light: float
    contrast: float = 1.0
    softness_px: float = 0.0


@with_config(CONFIG)
@dataclass(frozen=True)
class Looks:
    """The distribution from which looks are drawn.

    Attributes:
        exposures: light of an ordinary day, uniform: darker and brighter than the photograph's.
        lit_share: share of the passes with any light.
        lights: from deep shade to saturated areas, log-uniform.
        calm_share: share of the passes with reduced contrast.
        contrasts: share of the contrast that is left in them, log-uniform.
        soft_share: share of the passes over softer ground.
        softness_px: in target pixels, uniform.
    """

    exposures: Range = (0.5, 1.25)
    lit_share: Amount = 0.0
    lights: Range = (0.03, 2.5)
    calm_share: Amount = 0.0
    contrasts: Range = (0.05, 1.0)
    soft_share: Amount = 0.0
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
