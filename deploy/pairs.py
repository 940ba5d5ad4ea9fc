"""Simulated pairs for notebooks and scripts: an image as a sensor sees a scene, and as a better one
would have seen it.
"""

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beers_deploy.model.io.files import write_text
from beers_deploy.model.io.pictures import picture_url, stretch_of
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.raster.facts import require_pixel_type
from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.profiles.errors import ImageError, as_path
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor

if TYPE_CHECKING:
    from beers_deploy.model.simulator.detector import Draw
    from beers_deploy.model.simulator.sampling import Scene


@dataclass(frozen=True, eq=False, repr=False)
class Pair:
    """Two simulated images of one scene: by a sensor, and by the better one that is the target.

    `simulate` returns a pair. Unpacking it yields the degraded and the reference image. A digital
    number (DN) stands for the same radiance in all images.

    Attributes:
        degraded: the image of the sensor, (H, W) uint16, in DN.
        reference: the image of the better sensor, (H, W) uint16, in DN.
        clean: the reference without noise and rounding, (H, W) float32, in DN.
        sensor: the sensor as simulated, with one value drawn from each range of its profile.
        profiles: the profiles (degraded, reference) from which the values were drawn.

    Examples:
        >>> pair = bd.simulate(size=96)
        >>> bool(pair.psnr(pair.degraded) < pair.psnr(pair.reference))
        True
    """

    degraded: np.ndarray
    reference: np.ndarray
    clean: np.ndarray
    sensor: Instrument
    profiles: tuple[Sensor, Sensor]

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.degraded, self.reference))

    def psnr(self, image: np.ndarray) -> float:
        """Compute the PSNR of an image against the reference, with full scale as the peak.

        Args:
            image: an image (H, W) in DN, for example a restoration of `degraded`.

        Returns:
            The peak signal-to-noise ratio in dB; higher is more similar.

        Raises:
            ImageError: the image has another shape, or pixels that are no numbers.
        """
        return psnr_db(self._alike(image), self.reference, self.sensor.max_dn)

    def ssim(self, image: np.ndarray) -> float:
        """Compute the structural similarity of an image and the reference, over full scale.

        Args:
            image: an image (H, W) in DN, for example a restoration of `degraded`.

        Returns:
            The mean SSIM; 1 for equal images.

        Raises:
            ImageError: the image has another shape, pixels that are no numbers, or is smaller than
                the window of 11 pixels.
        """
        return ssim(self._alike(image), self.reference, self.sensor.max_dn)

    def _alike(self, image: np.ndarray) -> np.ndarray:
        pixels = np.asarray(image)
        require_pixel_type("`image`", pixels.dtype)
        if pixels.shape != self.reference.shape:
            raise ImageError(
                f"`image` has the shape {pixels.shape}, but the reference has the shape "
                f"{self.reference.shape}. Compare images of one size."
            )
        return pixels

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write both images as TIFFs that `beers-deploy evaluate --pairs` reads.

        The record of the sensors, recipe.json, is written next to them.

        Args:
            folder: the folder to write; the images go to its subfolders degraded and reference.

        Returns:
            The folder.
        """
        out = as_path(folder)
        for role, image in (("degraded", self.degraded), ("reference", self.reference)):
            write_tiff(out / role / "0000-drawn.tif", image)
        degraded, reference = map(asdict, self.profiles)
        recipe = {"scenes": [{"name": "drawn"}], "degraded": degraded, "reference": reference}
        write_text(out / "recipe.json", json.dumps(recipe, indent=1, sort_keys=True) + "\n")
        return out

    def __repr__(self) -> str:
        height, width = self.degraded.shape
        return f"Pair({width} x {height} px, {self.profiles[0].name} -> {self.profiles[1].name})"

    def _repr_html_(self) -> str:
        stretch = stretch_of(self.reference)
        panels = (("degraded", self.degraded), ("reference", self.reference), ("clean", self.clean))
        pictures = [
            '<figure style="display: inline-block; margin: 4px"><img '
            f'src="{picture_url(stretch.to_bytes(image))}" '
            f'style="max-width: 30em; width: 100%"><figcaption>{name}</figcaption></figure>'
            for name, image in panels
        ]
        return "".join(pictures)


def simulated_pair(
    scene: Any,
    degraded: Sensor,
    reference: Sensor,
    size_px: int,
    radiance_scale: float,
    ratio: int,
    seed: int,
) -> Pair:
    """Simulate the images that two sensors acquire of one scene; the work of `simulate`.

    Args:
        scene: an image file or its pixels: 8 bits, 16-bit digital numbers, or float radiance in
            W/m2/sr/um. If None, a synthetic scene is drawn at random.
        degraded: the sensor. A value is drawn from each range of its profile.
        reference: the better sensor. Its gain, bits and offset are replaced by those of `degraded`,
            so that the digital numbers of both images mean the same.
        size_px: side of the images in pixels; it applies to a drawn scene only.
        radiance_scale: the factor by which the scene's radiance is multiplied.
        ratio: the number of scene pixels for each image pixel, along either side.
        seed: the seed of every random draw.

    Returns:
        The pair of images, with the sensor as it was drawn.

    Raises:
        ImageError: the scene cannot be read, or is too small for the margin that the blur needs.
    """
    from beers_deploy.model.simulator.acquire import acquire_three, prepare_scene
    from beers_deploy.model.simulator.detector import Draw, to_uint16

    aim = reference.in_units_of(degraded)

    draw = Draw(seed)
    radiance = _scene(scene, aim.nominal(), size_px, ratio, draw).radiance * radiance_scale
    # Each sensor has a generator of its own: leaving one draw out does not change the others.
    instrument, aim_instrument = (
        profile.draw(draw.generator(f"sensor-{role}"))
        for role, profile in (("degraded", degraded), ("reference", aim))
    )
    degraded_dn, reference_dn, clean = acquire_three(
        prepare_scene(radiance, ratio), instrument, aim_instrument, draw
    )
    return Pair(to_uint16(degraded_dn), to_uint16(reference_dn), clean, instrument, (degraded, aim))


def _scene(
    scene: Any,
    sensor: Instrument,
    size_px: int,
    ratio: int,
    draw: "Draw",
) -> "Scene":
    from beers_deploy.model.simulator.acquire import scene_side_px
    from beers_deploy.model.simulator.procedural import procedural_scene
    from beers_deploy.model.simulator.sampling import read_scene, scene_of

    if scene is None:
        side_px = scene_side_px(size_px, ratio)
        return procedural_scene(side_px, side_px, draw.generator("drawn scene"))
    if isinstance(scene, str | os.PathLike):
        return read_scene(Path(scene), sensor)
    return scene_of("scene", np.asarray(scene), sensor)
