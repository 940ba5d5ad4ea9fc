"""The warning that an image without a named sensor looks restored already.

Its noise is compared with that of the quietest sensor in range. Most satellite products are
denoised and sharpened before they are delivered. A network that is not given their sensor treats
them as images of an average one, and sharpens them a second time.
"""

from collections.abc import Sequence

import numpy as np
import onnx

from beers_deploy.model.family import RANGES
from beers_deploy.model.metrics.instrument import image_blocks
from beers_deploy.model.metrics.noise_blocks import ROUNDING
from beers_deploy.model.metrics.noise_line import LEAST
from beers_deploy.model.raster.source import Source
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.sensor_check.check import band_windows, integer_step
from beers_deploy.restoration.sensor_check.comparison import QUIET_PERCENT

FAR_BELOW = 0.4
"""A share of the variance of the quietest sensor, in a tenth of the blocks. An image with less is
not raw.

Four Pleiades products have 0.01 to 0.04. Of images simulated by sensors of the range, at 1, 1/4 and
1/20 of the light, the lowest has 0.76, and chance alone may leave 0.6. An 11-bit image that is
mistaken for 12 bits retains half of it.
"""
OFFSET = 0.01
"""The largest dark level that an image may have, as a share of full scale."""
LEAST_EXPECTED = 3 * ROUNDING
"""The least expected variance. Below this, rounding to integers hides the noise of a raw image as
well.
"""
FILLED = 1e-9
"""Blocks with less variance are constant, so they are filled and not acquired."""


def restored_already(source: Source, networks: Sequence[onnx.ModelProto], full_scale: float) -> str:
    """Return the warning that an image without a named sensor looks restored already.

    An image has been denoised, and so is not raw, if its noise is far below that of the quietest
    sensor that the networks were trained for.

    Args:
        source: the image.
        networks: the networks that are to restore the image. The sensors that they were trained for
            are known only if each states a sensor in its metadata, "blind" included.
        full_scale: the pixel value that is 1.0 to the networks.

    Returns:
        The warning; empty if the image looks raw, its noise cannot be measured, or the sensors are
        not known.
    """
    if not all(metadata(network).get("sensor") for network in networks):
        return ""
    # Most satellite products are denoised before delivery, which their noise reveals.
    shares = [_noise_share(windows, full_scale) for windows in band_windows(source)]
    quiet = [k for k, share in enumerate(shares, 1) if share is not None and share < FAR_BELOW]
    if not quiet:
        return ""
    least = min(share for share in shares if share is not None)
    some = "" if len(quiet) == len(shares) else f" in band {', '.join(map(str, quiet))}"
    return (
        f"look at the image: it looks restored already{some}, with {least:.0%} of the noise "
        "variance of the quietest sensor that the network knows at full scale "
        f"{full_scale:g}; a restoration over-sharpens it: give the raw image, or its own sensor "
        "or full scale"
    )


def _noise_share(windows: Sequence[np.ndarray], full_scale: float) -> float | None:
    """Return the noise's variance relative to the least of any sensor in range, in quiet blocks, or
    None if it cannot be measured.

    Args:
        windows: (h, w) each, raw values; 0 where pixels are missing.
        full_scale: the value that is the sensors' largest digital number.
    """
    step = integer_step(windows)
    # Pixels that were scaled have an unknown noise of rounding.
    if step is None:
        return None
    top = full_scale / step
    blocks = image_blocks((window / step for window in windows), top)
    # The least variance over all sensors that the networks were trained for. It is defined at 1/16
    # and at 1/4 of full scale. A straight line through 0 and the first, and a constant from the
    # second on, lie below the noise line of every sensor of the range, also where the dark is above
    # 0.
    light = np.maximum(blocks.mean / top - OFFSET, 0)
    dark = RANGES["sigma_dark"][0] ** 2
    bright = RANGES["sigma_bright"][0] ** 2
    expected = top**2 * np.minimum(16 * dark * light, bright)
    judged = (expected >= LEAST_EXPECTED) & (blocks.fine > FILLED)
    if int(judged.sum()) < LEAST:
        return None
    return float(np.percentile(blocks.fine[judged] / (expected[judged] + ROUNDING), QUIET_PERCENT))
