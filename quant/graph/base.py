"""Make the base to which a network adds its result: the image, some of its channels, enlarged.

Networks that read a map of the noise level or several frames add to some channels, those for
super-resolution to the enlarged image. The host does it in float, as ONNX's Resize does.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from beers_deploy.quant.onnx.resize import CUBIC

Mode = Literal["nearest", "linear", "cubic"]
"""The interpolation of an enlarged image, in ONNX's words."""
REACH_PX = 2
"""The number of pixels around a pixel's own that an enlargement reads at most."""


@dataclass(frozen=True)
class Base:
    """The base that is made of an image.

    Attributes:
        channels: the numbers of the image's channels that the base has; empty for all.
        factor: the factor of rows and columns; 1 leaves the image as it is.
        mode: the interpolation, with half-pixel centres and repeated borders.
    """

    channels: tuple[int, ...] = ()
    factor: int = 1
    mode: Mode = "nearest"

    @property
    def weights(self) -> np.ndarray:
        """The weights (factor, 2 REACH_PX + 1) float32 of the pixels around a pixel, for each
        of the pixels that it becomes along an axis.
        """
        places = (np.arange(self.factor) + 0.5) / self.factor - 0.5
        if self.mode == "nearest":
            places = np.zeros(self.factor)
        distances = np.abs(np.arange(-REACH_PX, REACH_PX + 1) - places[:, None])
        if self.mode != "cubic":
            return np.asarray(np.maximum(1 - distances, 0), np.float32)
        # R. Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 1981.
        near = (CUBIC + 2) * distances**3 - (CUBIC + 3) * distances**2 + 1
        far = CUBIC * (distances**3 - 5 * distances**2 + 8 * distances - 4)
        weights = np.where(distances <= 1, near, np.where(distances < 2, far, 0))
        return np.asarray(weights, np.float32)

    def kernel(self, channels: int) -> np.ndarray:
        """Return the weights (C, C, k, k) float32 of a transposed convolution, of stride `factor`,
        that enlarges as this does, but for the border.

        Args:
            channels: the number C of channels.
        """
        # Pixel p of those that a pixel becomes reads its neighbour at offset o by the weight
        # p - o factor, counted from the middle.
        taps = self.weights[:, ::-1].T.ravel()
        # The weights at the ends are 0, because no pixel of an even factor is that far from its
        # neighbour.
        half = self.factor // 2
        taps = taps[half:-half]
        weight = np.eye(channels)[:, :, None, None] * np.outer(taps, taps)
        return np.asarray(weight, np.float32)

    @property
    def kernel_pad(self) -> int:
        """The pads of that convolution at each side, with which the result has the size of the
        enlarged image.
        """
        return REACH_PX * self.factor - self.factor // 2

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the base (N, C', factor H, factor W) of an image (N, C, H, W)."""
        if self.channels:
            image = image[:, list(self.channels)]
        if self.factor == 1:
            return image
        # First along the columns, then along the rows.
        for _ in range(2):
            count, channels, height, width = image.shape
            wide = np.pad(image, [(0, 0), (0, 0), (REACH_PX, REACH_PX), (0, 0)], "edge")
            phases = [
                sum(weight * wide[:, :, k : k + height] for k, weight in enumerate(phase))
                for phase in self.weights
            ]
            tall = np.stack(phases, axis=3).reshape(count, channels, self.factor * height, width)
            image = tall.swapaxes(2, 3)
        return image


THE_IMAGE = Base()
"""The base that is the image itself."""
