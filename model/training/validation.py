"""Judging a run on sites that it does not train on."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from beers_deploy.model.convbeers import Network, told, vector_tensor
from beers_deploy.model.family import SensorFamily
from beers_deploy.model.io.images import site_of
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.simulator.acquire import LEAST_SIDE_PX, fitting_oversampling, simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.profiles.sensor import Sensor

SHARE = 0.05
"""Of the images: sites are held out, the ones with the fewest images first, until so many are."""

SIDE_PX = 192
OVERSAMPLINGS = (4, 3, 2, 1)


def split_by_site(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Numbers of the images to train on, and of those held out: whole sites, always the same ones.

    Fewer than three sites are all trained on: nothing is held out.
    """
    sites: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        sites.setdefault(site_of(name), []).append(number)
    held: list[int] = []
    if len(sites) >= 3:
        for site in sorted(sites, key=lambda s: (len(sites[s]), s)):
            if len(held) >= SHARE * len(names):
                break
            held += sites[site]
    return [n for n in range(len(names)) if n not in held], sorted(held)


class Validation:
    """Pairs (1, 1, H, W) in [0, 1] from scenes that are not trained on, the same in every run.

    Scenes too small to leave anything within the margin are left out.
    """

    def __init__(self, scenes: Sequence[Scene], degraded: Sensor | SensorFamily, reference: Sensor) -> None:
        self.names, self.pairs, self.vectors = list[str](), list[tuple[Tensor, Tensor]](), list[Tensor]()
        for number, scene in enumerate(scenes):
            ratio = fitting_oversampling(scene.radiance, OVERSAMPLINGS, LEAST_SIDE_PX)
            if ratio is None:
                continue
            draw = Draw(0, number)
            sensors = [profile.draw(draw.generator("sensor")) for profile in (degraded, reference)]
            pair = simulate_pair(scene.radiance, sensors[0], sensors[1], ratio, draw)
            height, width = (min(side, SIDE_PX) for side in pair.degraded.shape)
            both = (pair.degraded / sensors[0].max_dn, pair.reference / sensors[1].max_dn)
            degraded_image, reference_image = (torch.from_numpy(image[None, None, :height, :width]) for image in both)
            self.names.append(scene.name)
            self.pairs.append((degraded_image, reference_image))
            self.vectors.append(vector_tensor(sensors[0]))

    def restore(self, network: Network) -> list[np.ndarray]:
        """Each degraded image through the network in float32, (H, W), clipped to [0, 1].

        A conditioned network is told the sensor that acquired the image. An image whose sides are no
        multiples of the network's scale is extended by copies of its last row and column, as in a restoration.
        """
        restored = []
        for (degraded, _), vector in zip(self.pairs, self.vectors, strict=True):
            plain = told(network, vector)
            height, width = degraded.shape[-2:]
            lack = (-size % plain.variant.scale for size in (width, height))
            extended = pad(degraded, [each for side in lack for each in (0, side)], mode="replicate")
            with torch.inference_mode():
                restored.append(plain(extended)[0, 0, :height, :width].clamp(0, 1).numpy())
        return restored

    def judge(self, network: Network) -> dict[str, float]:
        """Means over the pairs of a network on the CPU, PSNR over full scale: by the names of a log's columns."""
        restored = self.restore(network)
        references = [reference[0, 0].numpy() for _, reference in self.pairs]
        inputs = [degraded[0, 0].numpy() for degraded, _ in self.pairs]
        judged = {"psnr_db": (psnr_db, restored), "degraded_psnr_db": (psnr_db, inputs), "ssim": (ssim, restored)}
        return {
            name: float(np.mean([score(a, b, 1.0) for a, b in zip(images, references, strict=True)]))
            for name, (score, images) in judged.items()
        }
