"""How the ground of a pass may look: its light, its contrast and its softness.

Aerial photographs are bright, sharp and rich in contrast, more so than most of what a satellite
sees. A network that learns from nothing else restores dark, hazy and soft ground worse than it
could.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.model.simulator.chart import log_uniform

Range = tuple[float, float]


@dataclass(frozen=True)
class Look:
    """How one pass over a scene looks.

    Attributes:
        light: factor on the scene's radiance.
        contrast: share of the contrast around the scene's mean that is left.
        softness_px: standard deviation of a further blur of the ground, in target pixels; 0 is
            none.
    """

    light: float
    contrast: float = 1.0
    softness_px: float = 0.0


@dataclass(frozen=True)
class Looks:
    """What looks are drawn.

    Attributes:
        exposures: light of an ordinary day, uniform: darker and brighter than the photograph's.
        lit_share: of the passes, those in any light at all.
        lights: from deep shade to saturated areas, log-uniform.
        calm_share: of the passes, those with less contrast.
        contrasts: what is left of it, log-uniform.
        soft_share: of the passes, those over softer ground.
        softness_px: in target pixels, uniform.
    """

    exposures: Range = (0.5, 1.25)
    lit_share: float = 0.0
    lights: Range = (0.03, 2.5)
    calm_share: float = 0.0
    contrasts: Range = (0.05, 1.0)
    soft_share: float = 0.0
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
"""Photographs as they are, on days of different light."""
