"""Extend the consistency step to finer detail, for MTF curves that networks were not trained on.

    x'' = x' + (G_2 - G_8) (y - H x)

G_b averages over blocks of b x b pixels and interpolates bilinearly; G_8 is G of `step`, whose
blocks have 8 pixels. The difference of the two is a band-pass filter for periods of about 4 to 30
pixels. A network conditioned on the contrast at Nyquist alone amplifies these periods as if the
sensor's curve were the formula's. For another curve the residual there is not noise but a part of
the scene. Behind a Gaussian curve the step brings `convbeers-s` in INT8 from 47.5 to 48.5 dB
(measured on 22 photographs of other places).

The step adds a third of the noise of y, so it is used only where the curve departs from the
formula's. There it gains in dark scenes too, while for the formula's own curve it would lose up to
0.1 dB at a twentieth of the radiance (measured on photographs of training places).

Only the near part of H is needed, because G_2 - G_8 removes what varies slowly.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.model.consistency.blocks import (
    BLOCK_PX,
    Image,
    Placed,
    block_means,
    interpolate,
    weighted_sums,
)
from beers_deploy.profiles.response import Array

FINE_PX = 2
"""Side of a fine block.

Blocks of 4 pixels gained 0.2 to 0.5 dB less behind curves that no network was trained on (measured
on photographs of training places); single pixels would add more noise than detail.
"""


@dataclass(frozen=True)
class DetailStep:
    """The correction (G_2 - G_8) (y - H x) for images of one sensor.

    Attributes:
        rows: weights (terms, FINE_PX + 2 NEAR_PX) of the rows that enter a fine block's mean of
            H x.
        columns: weights of the columns, likewise.
    """

    rows: Image
    columns: Image

    @classmethod
    def of(cls, rows: Array, columns: Array) -> "DetailStep":
        """Build the step from the separable filters (terms, 2 NEAR_PX + 1) of H's near part."""
        return cls(window_weights(rows, FINE_PX), window_weights(columns, FINE_PX))

    def correction(self, raw: Image, restored: Image, down: Placed, across: Placed) -> Image:
        """Compute the correction for the kept pixels, which is 0 at the image's border.

        Args:
            raw: y, the pixels of all blocks of `down` and `across`.
            restored: x, the restored pixels of these blocks, with NEAR_PX more on every side.
            down: where the rows lie, and which are kept.
            across: where the columns lie, likewise.

        Returns:
            (kept rows, kept columns) float32, to be added to x.
        """
        residual = block_means(raw, FINE_PX) - separable_sums(
            restored, self.rows, self.columns, FINE_PX
        )
        means = block_means(residual, BLOCK_PX // FINE_PX)
        change = interpolate(residual, down, across, FINE_PX) - interpolate(means, down, across)
        return change * down.inside[:, None] * across.inside


def window_weights(vectors: Array, block_px: int) -> Image:
    """Return the weights with which pixels enter the mean of a block after convolution.

    Args:
        vectors: (terms, 2 R + 1) filters along one side.
        block_px: side of a block.

    Returns:
        (terms, block_px + 2 R), from R pixels before the block to R pixels behind it.
    """
    box = np.full(block_px, 1 / block_px)
    # Convolution turns a filter around; the sums go forwards.
    return np.array([np.convolve(vector[::-1], box) for vector in vectors], np.float32)


def separable_sums(image: Image, rows: Image, columns: Image, block_px: int) -> Image:
    """Return the means of blocks of an image that a sum of separable filters has blurred.

    Args:
        image: the pixels of the blocks and as many around them as the filters reach.
        rows: weights of the rows of each term, see `window_weights`.
        columns: weights of the columns, likewise.
        block_px: side of a block.
    """
    terms = zip(rows, columns, strict=True)
    sums = (
        weighted_sums(weighted_sums(image, row, 0, block_px), column, 1, block_px)
        for row, column in terms
    )
    return np.asarray(sum(sums))
