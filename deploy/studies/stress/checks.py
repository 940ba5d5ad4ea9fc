"""The measures on a hard case, and their bounds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from skimage.morphology import dilation, erosion

from beers_deploy.profiles.errors import BeersError
from beers_deploy.studies.stress.cases import FULL_DN

FLAT_DN = 0.01 * FULL_DN
"""One per cent of full scale: the largest change of the mean, and the largest excess that does not
count as ringing.
"""

RINGING_PERCENT = 100.0
"""The largest ringing, in percent of the contrast around it."""

Work = Callable[[np.ndarray], np.ndarray]
"""Maps an image (H, W) in DN to another."""


@dataclass(frozen=True)
class Measure:
    """The value that a check measured on one image, and the bound that it must not exceed.

    Attributes:
        check: the name of the check.
        value: the measured value. NaN exceeds every bound.
        allowed: the largest value that is allowed.
        unit: the unit of both values.
    """

    check: str
    value: float
    allowed: float
    unit: str = "DN"

    @property
    def holds(self) -> bool:
        """True if the value is at most the allowed one."""
        return self.value <= self.allowed


def not_finite(pixels: np.ndarray) -> Measure:
    """Count the pixels, of any shape, that are NaN or infinite."""
    return Measure("not finite", float((~np.isfinite(pixels)).sum()), 0, "px")


def differing(check: str, image: np.ndarray, other: np.ndarray) -> Measure:
    """Count the pixels of two images (H, W) that differ in any bit, as the check named `check`. NaN
    equals NaN.
    """
    # NaN differs from itself, and a missing pixel is the same in both.
    same = (image == other) | (np.isnan(image) & np.isnan(other))
    return Measure(check, float((~same).sum()), 0, "px")


def ringing(image: np.ndarray, source: np.ndarray, radius_px: int, allowed: float) -> Measure:
    """Measure ringing: how far restored pixels leave the range of the raw pixels around them,
    relative to the contrast there.

    One per cent of full scale does not count. The contrast is taken as at least ten per cent,
    because flat ground has none.

    Args:
        image: the restored image (H, W) in DN.
        source: the raw image (H, W) in DN.
        radius_px: the distance along both axes within which raw pixels count.
        allowed: the largest ringing that is allowed, in % of the contrast.
    """
    low, high = local_range(source, radius_px)
    # Rounding and noise leave the range by a little on any ground.
    beyond = np.maximum(np.maximum(image - high, low - image) - FLAT_DN, 0)
    share = beyond / np.maximum(high - low, 10 * FLAT_DN)
    return Measure("ringing", 100 * float(share.max()), allowed, "% of contrast")


def local_range(image: np.ndarray, radius_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return, for every pixel of an image (H, W), the smallest and the largest pixel in the square
    around it.

    Args:
        image: the image (H, W).
        radius_px: the distance from a pixel to the sides of its square, which is cut at the image's
            border.

    Returns:
        The smallest and the largest pixels, two images (H, W).
    """
    square = np.ones((2 * radius_px + 1, 2 * radius_px + 1))
    return erosion(image, square), dilation(image, square)


def gain(
    work: Work, source: np.ndarray, result: np.ndarray, generator: np.random.Generator
) -> float:
    """Measure how strongly a restoration amplifies small changes of its input.

    Two changes of 1 DN are tried: of the pixel in the middle, and of all pixels with random signs.

    Args:
        work: the restoration, a function from an image (H, W) in DN to another.
        source: the raw image (H, W) in DN.
        result: the restored image, `work(source)`.
        generator: draws the signs.

    Returns:
        The largest change of any restored pixel in DN.
    """
    one = np.zeros(source.shape, np.float32)
    one[source.shape[0] // 2, source.shape[1] // 2] = 1
    signs = generator.choice(np.array([-1, 1], np.float32), source.shape)
    return max(change(work, source, result, nudge) for nudge in (one, signs))


def change(work: Work, source: np.ndarray, result: np.ndarray, nudge: np.ndarray) -> float:
    """Measure how much a restoration changes if its input does.

    Args:
        work: the restoration, a function from an image (H, W) in DN to another.
        source: the raw image (H, W) in DN.
        result: the restored image, `work(source)`.
        nudge: the change of each raw pixel, -1, 0 or 1 DN, (H, W). Its sign is reversed where the
            pixel would leave 0 to 4095.

    Returns:
        The largest change of any restored pixel in DN.
    """
    target = source + nudge
    # Reverse the nudge where it would leave the converter's range.
    nudged = np.where((target < 0) | (target > FULL_DN), source - nudge, target)
    return float(np.abs(work(np.asarray(nudged, np.float32)) - result).max())


def refused(work: Callable[[], object]) -> Measure:
    """Check that some work is refused with a BeersError: the measure is 0 if it is, else 1.

    Args:
        work: restores an image with invalid pixels.
    """
    try:
        work()
    except BeersError:
        return Measure("not refused", 0, 0, "runs")
    return Measure("not refused", 1, 0, "runs")


def inside(image: np.ndarray, margin_px: int) -> np.ndarray:
    """Return an image (H, W) without a margin of `margin_px` on each side, or the whole image if
    less than two rows or columns would be left.
    """
    if min(image.shape) <= 2 * margin_px + 1:
        return image
    return image[margin_px : image.shape[0] - margin_px, margin_px : image.shape[1] - margin_px]


def fidelity(image: np.ndarray, result: np.ndarray, radius_px: int, flat: bool) -> list[Measure]:
    """Measure if a restoration adds ringing and, on flat ground, if it changes the brightness.

    Args:
        image: the raw image (H, W) in DN.
        result: the restored image (H, W) in DN.
        radius_px: the network's receptive radius, within which the border has an effect.
        flat: True if all pixels of the raw image are equal.

    Returns:
        The ringing away from the border; on flat ground also the change of the mean there, and the
        largest change of any pixel.
    """
    inner = inside(result, radius_px)
    measures = [ringing(inner, inside(image, radius_px), radius_px, RINGING_PERCENT)]
    if flat:
        # On flat ground, any error at the border is caused by the padding.
        border = Measure("border", float(np.abs(result - image).max()), 2 * FLAT_DN)
        shift_dn = abs(float(np.mean(inner, dtype=np.float64) - np.mean(image, dtype=np.float64)))
        measures += [Measure("mean moved", shift_dn, FLAT_DN), border]
    return measures


NETWORKS = ("float32", "INT8")


@dataclass(frozen=True)
class Limitation:
    """A known limitation of the networks, which explains some measures outside their bounds.

    A measure beyond the ceiling of the limitation is a failure all the same.

    Attributes:
        name: the name in tables.
        checks: the names of the checks that it explains.
        ceiling: the largest value of such a check that it explains, in the unit of the check.
        meaning: its meaning for a user, in a sentence.
        cases: the names of the hard cases that it applies to; empty for all cases.
        stages: the names of the stages (ways of running the networks) at which it is known.
    """

    name: str
    checks: tuple[str, ...]
    ceiling: float
    meaning: str
    cases: tuple[str, ...] = ()
    stages: tuple[str, ...] = NETWORKS


LIMITATIONS: tuple[Limitation, ...] = (
    Limitation(
        "narrow images",
        ("ringing", "mean moved", "border"),
        1000,
        "Of an image narrower than the receptive radius every pixel has padding in reach: "
        "brightness is not kept.",
        ("1 x 1", "1 x N", "flat 1 x N"),
    ),
    Limitation(
        "border",
        ("border",),
        500,
        "At the image's border zero padding looks like a black edge to the network; within its "
        "receptive radius bright flat ground is off, in INT8 more, which clips the correction that "
        "float makes there.",
    ),
    Limitation(
        "clipped corrections",
        ("mean error against float",),
        410,
        "int8 holds corrections of about half of full scale at most; where float makes larger "
        "ones, on full contrast between single pixels, INT8 sharpens less.",
        stages=("INT8",),
    ),
    Limitation(
        "isolated pixels",
        ("ringing",),
        200,
        "A single pixel unlike all around it is taken for a blurred point and driven beyond its "
        "value, to black or full scale at most.",
        ("snow", "glint", "hot pixel", "SNR 3"),
    ),
)


def limitation_of(stage: str, case: str, measure: Measure) -> Limitation | None:
    """Return the known limitation that explains a measure outside its bound, or None.

    Args:
        stage: the name of the stage at which it was measured.
        case: the name of the hard case.
        measure: the measure.
    """
    for limit in LIMITATIONS:
        applies = stage in limit.stages and measure.check in limit.checks
        if applies and case in (limit.cases or [case]) and measure.value <= limit.ceiling:
            return limit
    return None
