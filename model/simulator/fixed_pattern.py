"""Fixed-pattern noise of a push-broom sensor: each column of the image is one detector, the same in every row."""

import numpy as np
import torch
from torch import Tensor

from profiles.effects import Dsnu, Prnu, Striping

PATTERN_LIMIT = 4.0
"""Detectors further out are rejected at the factory: draws are clipped here, so that bounds can be proven."""


def apply_prnu(radiance: Tensor, prnu: Prnu, generator: np.random.Generator) -> Tensor:
    """L' = (1 + rms * n) * L, n standard normal per column, clipped at 4; rms 0 changes nothing."""
    return radiance * (1 + prnu.rms * _columns(radiance, generator))


def apply_dsnu(dn: Tensor, dsnu: Dsnu, generator: np.random.Generator) -> Tensor:
    """DN' = DN + rms_dn * n, n standard normal per column, clipped at 4; rms_dn 0 changes nothing."""
    return dn + dsnu.rms_dn * _columns(dn, generator)


def apply_striping(dn: Tensor, striping: Striping) -> Tensor:
    """Half of odd_even_dn is added to even columns and taken from odd ones; 0 changes nothing."""
    columns = torch.arange(dn.shape[-1], device=dn.device)
    return dn + striping.odd_even_dn * (0.5 - (columns % 2).to(dn.dtype))


def _columns(image: Tensor, generator: np.random.Generator) -> Tensor:
    """One clipped standard normal number a column, (W,) float32."""
    draw = generator.standard_normal(image.shape[-1], dtype=np.float32)
    return torch.from_numpy(np.clip(draw, -PATTERN_LIMIT, PATTERN_LIMIT)).to(image.device)
