"""One generator per random effect, keyed by (seed, patch, effect).

So leaving out one effect changes no other draw, and any patch can be made again by itself.
"""

import zlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Draw:
    """What names a patch's randomness: the run's seed and the patch's number."""

    seed: int
    patch: int = 0

    def generator(self, effect: str) -> np.random.Generator:
        """The generator of one effect of this patch; counter-based (Philox), the same on every machine."""
        entropy = (self.seed, self.patch, zlib.crc32(effect.encode()))
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))
