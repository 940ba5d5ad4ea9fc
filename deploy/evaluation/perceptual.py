"""Which perceptual distances can be had here: those whose backbone the user brings."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from model.metrics.backbone_files import find_backbone, not_found
from model.metrics.perceptual import Dists, Lpips

Perceptual = Callable[[np.ndarray, np.ndarray], float]
"""Distance of two images (H, W) in [0, 1] of full scale."""


def perceptual_distances(place: Path | None) -> dict[str, Perceptual | str]:
    """LPIPS-squeeze or the reason why not, and LPIPS-alex, LPIPS-vgg and DISTS where their backbones are found.

    Args:
        place: a file with SqueezeNet 1.1, or a folder with any of the backbones; None asks the environment.

    Raises:
        ModelError: a file that is missing or holds something else.
    """
    found: dict[str, Perceptual | str] = {"LPIPS-squeeze": not_found("squeeze")}
    for network in ("squeeze", "alex", "vgg"):
        if network != "squeeze" and place is not None and not place.is_dir():
            break
        file = find_backbone(network, place)
        if file is None:
            continue
        found[f"LPIPS-{network}"] = _distance(Lpips.load(network, file))
        if network == "vgg":
            found["DISTS"] = _distance(Dists.load(file))
    return found


def _distance(metric: Lpips | Dists) -> Perceptual:
    def distance(image: np.ndarray, reference: np.ndarray) -> float:
        both = [torch.from_numpy(np.asarray(a, np.float32))[None, None] for a in (image, reference)]
        with torch.inference_mode():
            return float(metric(*both))

    return distance
