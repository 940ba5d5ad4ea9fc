"""Dead and hot pixels."""

import numpy as np
import torch
from torch import Tensor

from profiles.effects import Defects


def add_defects(dn: Tensor, defects: Defects, max_dn: int, generator: np.random.Generator) -> Tensor:
    """A pixel is dead (0 DN) or hot (max_dn) with its rate per million, independently; rates 0 change nothing."""
    draw = torch.from_numpy(generator.random(tuple(dn.shape), dtype=np.float32)).to(dn.device)
    dead, hot = defects.dead_per_million / 1e6, defects.hot_per_million / 1e6
    dn = torch.where(draw < dead, torch.zeros_like(dn), dn)
    return torch.where(draw >= 1 - hot, torch.full_like(dn, float(max_dn)), dn) if hot > 0 else dn
