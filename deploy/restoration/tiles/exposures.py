"""A network at several exposures, as it restores the tiles of a band (see `model.exposure`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from beers_deploy.model.exposure import choose_factors
from beers_deploy.profiles.errors import ImageError, ModelError
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.quant.untrusted import times
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Plan, Span
from beers_deploy.restoration.runtime import Infer


@dataclass(frozen=True)
class ExposedNetwork:
    """A network that restores dark pixels, and pixels at strong edges, at an exposure of their own.

    For it, pixels are multiplied by a factor, restored by a version of the network for such images,
    and divided by the factor.

    Attributes:
        infers: the versions of the network, ready to run, by the factor. The factor 1 is among
            them, and alone if the network has no others.
        radius_px: the network's receptive radius. The pixels within it decide which factor a pixel
            gets.
        offset: the pixel value that the sensor stores without light, which is not multiplied.
    """

    infers: Mapping[float, Infer]
    radius_px: int = 0
    offset: float = 0.0

    def restore(
        self, window: np.ndarray, full_scale: float, spans: tuple[Span, Span], tiling: Tiling
    ) -> tuple[np.ndarray, Tally]:
        """Restore the window of one tile at each factor that its retained pixels need.

        Args:
            window: pixel values (bands, h, w), none missing; one band if there are several factors.
            full_scale: the pixel value that is 1.0 to the network.
            spans: the rows and columns of the image that the window reads and retains.
            tiling: the network's tiling geometry.

        Returns:
            The retained pixels (bands, h, w), float32 in 0..full_scale, not rounded; and the number
            of runs of the network, one for each factor, and of retained pixels that were restored
            at a factor above 1.

        Raises:
            ModelError: the result has another shape than the network's file states.
            ImageError: the network returns NaN or infinite values.
        """
        scale = int(tiling.scale)
        down, across = (span.keep_slice(span.start, scale) for span in spans)
        if len(self.infers) == 1:
            restored = restore_window(window, self.infers[1], full_scale)
            shape = tiling.channels_out, *(side * scale for side in window.shape[1:])
            if restored.shape != shape:
                raise ModelError(
                    f"The network returned a result of {times(restored.shape)}, but its file "
                    f"states {times(shape)}. Export it for images of any size, or check its sizes."
                )
            return restored[:, down, across], Tally(tiles=1, runs=1)
        image = np.asarray(window[0], np.float32)
        rising = sorted(self.infers)
        choice = choose_factors(image, rising, self.radius_px, full_scale, self.offset)
        # Only a network that returns one pixel for each pixel has several factors.
        choice = choice[down, across]
        pixels = np.zeros((1, *choice.shape), np.float32)
        offset = np.float32(self.offset)
        top = np.float32(full_scale)
        factors = np.unique(choice).tolist()
        for factor in factors:
            multiplied = image
            if factor != 1:
                multiplied = (image - offset) * np.float32(factor) + offset
                # Pixels that exceed full scale lie beyond the network's reach of every pixel that
                # takes this factor.
                multiplied = np.clip(multiplied, 0, top)
            restored = restore_window(multiplied[None], self.infers[factor], full_scale)
            if factor != 1:
                restored = np.clip((restored - offset) / np.float32(factor) + offset, 0, top)
            pixels = np.where(choice == factor, restored[:, down, across], pixels)
        tally = Tally(tiles=1, runs=len(factors), brightened=int((choice > 1).sum()))
        return pixels, tally


def tiles_by_factor(
    image: np.ndarray, plan: Plan, factors: Sequence[float], full_scale: float, offset: float
) -> dict[float, int]:
    """Count the tiles of an image that need each exposure, the factor by which pixels are
    multiplied before the network.

    Args:
        image: pixel values (H, W), none missing.
        plan: how the image is cut into tiles.
        factors: the factors that the network offers, in ascending order.
        full_scale: the pixel value that is 1.0 to the network.
        offset: the pixel value that the sensor stores without light.

    Returns:
        The number of tiles by the factor. A tile that needs several factors counts for each.
    """
    pixels = np.asarray(image, np.float32)
    choice = choose_factors(pixels, factors, plan.tiling.halo_px, full_scale, offset)
    counts = dict.fromkeys(factors, 0)
    for row, column in product(plan.rows, plan.columns):
        for factor in np.unique(choice[row.keep_slice(), column.keep_slice()]).tolist():
            counts[factor] += 1
    return counts


def restore_window(dn: np.ndarray, infer: Infer, full_scale: float) -> np.ndarray:
    """Run a network once on a window of pixel values.

    Args:
        dn: pixel values (bands, h, w), none missing.
        infer: the network, ready to run.
        full_scale: the pixel value that is 1.0 to the network.

    Returns:
        The network's result (bands', h', w'), float32 in 0..full_scale, not rounded.

    Raises:
        ImageError: the network returns NaN or infinite values.
    """
    image = np.ascontiguousarray(dn, dtype=np.float32)[None] / np.float32(full_scale)
    # Values that overflow are refused below.
    with np.errstate(over="ignore"):
        restored = infer(image)[0] * np.float32(full_scale)
    if not np.isfinite(restored).all():
        raise ImageError(
            "The network returned NaN or infinite pixels for a tile. Check the model with 'gate'."
        )
    return np.asarray(np.clip(restored, 0, np.float32(full_scale)))
