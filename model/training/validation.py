"""Validate on sites that are not trained on: choose them, compute figures, and draw a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from beers_deploy.model.bank import network_bank
from beers_deploy.model.convbeers import (
    TrainableNetwork,
    for_sensor,
    vector_tensor,
)
from beers_deploy.model.family import SensorFamily
from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.pictures import busiest_windows, grid, stretch_of, strip_row
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.raster.images import site_of
from beers_deploy.model.simulator.acquire import LEAST_SIDE_PX, fitting_oversampling, simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor

VALIDATION_CROP_PX = 96
ZOOM = 2

SHARE = 0.05
"""Sites with the fewest images are held out first, until this share of the images is held out."""

SIDE_PX = 192
OVERSAMPLINGS = (4, 3, 2, 1)


def split_by_site(
    names: Sequence[str], excluded: Sequence[str] = ()
) -> tuple[list[int], list[int]]:
    """Split images into those to train on and those held out, by whole sites and always equally.

    Args:
        names: the names of the images.
        excluded: sites to hold out. Without any, those with the fewest images are held out; with
            fewer than three sites none is.

    Returns:
        The numbers of the images to train on, and of those held out.

    Raises:
        OptionError: no image shows an excluded site.
    """
    sites: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        sites.setdefault(site_of(name), []).append(number)
    held_out: list[int] = []
    for site in excluded:
        if site not in sites:
            raise OptionError(
                f"The site {site!r} is to be held out, but no image shows it. Give the folders of "
                "all its images."
            )
        held_out += sites[site]
    if len(sites) >= 3 and not excluded:
        # The name breaks ties between sites of one size, so that the split is always the same.
        for site in sorted(sites, key=lambda s: (len(sites[s]), s)):
            if len(held_out) >= SHARE * len(names):
                break
            held_out += sites[site]
    return [n for n in range(len(names)) if n not in held_out], sorted(held_out)


class Validation:
    """The pairs by which a training is judged: images (1, 1, H, W) in [0, 1] of scenes that are not
    trained on, the same in every run.

    Scenes that are too small for the margin are excluded.
    """

    def __init__(
        self, scenes: Sequence[Scene], degraded: Sensor | SensorFamily, reference: Sensor
    ) -> None:
        self.names = list[str]()
        self.pairs = list[tuple[Tensor, Tensor]]()
        self.sensors = list[Instrument]()
        for number, scene in enumerate(scenes):
            ratio = fitting_oversampling(scene.radiance, OVERSAMPLINGS, LEAST_SIDE_PX)
            if ratio is None:
                continue
            # The seed is always 0, so that validation is the same in every run.
            draw = Draw(0, number)
            sensors = [profile.draw(draw.generator("sensor")) for profile in (degraded, reference)]
            pair = simulate_pair(scene.radiance, sensors[0], sensors[1], ratio, draw)
            height, width = (min(side, SIDE_PX) for side in pair.degraded.shape)
            both = (pair.degraded / sensors[0].max_dn, pair.reference / sensors[1].max_dn)
            degraded_image, reference_image = (
                torch.from_numpy(image[None, None, :height, :width]) for image in both
            )
            self.names.append(scene.name)
            self.pairs.append((degraded_image, reference_image))
            self.sensors.append(sensors[0])

    def restore(self, network: TrainableNetwork) -> list[np.ndarray]:
        """Restore each degraded image with the network in float32, (H, W), clipped to [0, 1].

        A conditioned network is given the sensor that acquired the image. An image whose sides are
        no multiples of the network's scale is extended by copies of its last row and column, as in
        a restoration.
        """
        restored = []
        for (degraded, _), sensor in zip(self.pairs, self.sensors, strict=True):
            restorer = for_sensor(network, vector_tensor(sensor), network_bank(sensor))
            height, width = degraded.shape[-2:]
            right = -width % restorer.variant.scale
            below = -height % restorer.variant.scale
            extended = pad(degraded, [0, right, 0, below], mode="replicate")
            with torch.inference_mode():
                restored.append(restorer(extended)[0, 0, :height, :width].clamp(0, 1).numpy())
        return restored

    def judge(self, restored: list[np.ndarray]) -> dict[str, float]:
        """Compute means of the figures over all pairs; PSNR is over full scale.

        Args:
            restored: the restored images, as `restore` returns them.

        Returns:
            The means, by the names of a log's columns.
        """
        references = [reference[0, 0].numpy() for _, reference in self.pairs]
        inputs = [degraded[0, 0].numpy() for degraded, _ in self.pairs]
        judged = {
            "psnr_db": (psnr_db, restored),
            "degraded_psnr_db": (psnr_db, inputs),
            "ssim": (ssim, restored),
        }
        return {
            name: float(
                np.mean([score(a, b, 1.0) for a, b in zip(images, references, strict=True)])
            )
            for name, (score, images) in judged.items()
        }


def write_picture(validation: Validation, restored: list[np.ndarray], path: Path) -> None:
    """Draw the busiest crop of each validation image: degraded, restored, reference."""
    rows: list[list[np.ndarray]] = []
    for (degraded, reference), result in zip(validation.pairs, restored, strict=True):
        images = [degraded[0, 0].numpy(), result, reference[0, 0].numpy()]
        side = min(VALIDATION_CROP_PX, *images[0].shape)
        top, left = busiest_windows(images[2], side)[0]
        crops = (image[top : top + side, left : left + side] for image in images)
        rows.append(strip_row(crops, stretch_of(images[2])))
    # Scenes may differ in size, but the cells of a grid have one size.
    smallest = min(row[0].shape for row in rows)
    cells = [[cell[: smallest[0], : smallest[1]] for cell in row] for row in rows]
    with whole_file(path) as temporary:
        grid(["degraded", "restored", "reference"], cells, ZOOM).save(
            temporary, "PNG", optimize=True
        )
