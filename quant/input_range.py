"""Handle the ranges of a network's input if its channels are not all in [0, 1].

A network may read pixels of 0 to 255, normalised ones such as (x - 0.485) / 0.229, or a map of
noise levels in addition to the image. Images and samples have the network's own units. Figures are
shares of a range, so that 1 is full scale for every network.
"""

from collections.abc import Iterable

import numpy as np

from beers_deploy.profiles.errors import OptionError, listed, printable

Ranges = tuple[tuple[float, float], ...]
"""(low, high) of each channel of the image; empty if all are in [0, 1]."""

UNIT = (0.0, 1.0)
KEY = "input_range"
"""The metadata key in an INT8 file of the ranges in words, and of whether they come from samples
only.
"""
FROM_SAMPLES = "found in the samples"
LARGEST = 1 + 1e-6
"""The largest share of a range that counts as 1, which allows for rounding."""
SIZES = 1e-6, 65536.0
"""The smallest and the largest absolute value of the end of a range."""
AROUND_UNIT = -0.1, 1.1
"""The range of nearly all results of a network that returns an image in [0, 1],
overshoot included.
"""
NEARLY_ALL = 0.99
MOST = 0.5
"""The least share of a float network's results in its ranges from which they count as an image, not
as values of another scale.
"""


def read_ranges(option: object, channels: int) -> Ranges:
    """Read the ranges of a network's input that a user states.

    Args:
        option: text LOW,HIGH or such a pair for each channel, or an array of the same numbers.
        channels: the number of the network's channels.

    Returns:
        A pair (low, high) for each channel; empty if all are [0, 1].

    Raises:
        OptionError: the option has another form or another number of pairs, or a pair is no range.
    """
    try:
        pairs = np.array(listed(option), float).reshape(-1, 2)
        if len(pairs) not in (1, channels):
            raise ValueError(f"{len(pairs)} pairs")
        ranges = tuple((float(low), float(high)) for low, high in pairs)
        require_ranges(ranges)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"`input_range` must be LOW,HIGH with LOW below HIGH and sizes up to {SIZES[1]:g}, or "
            f"such a pair for each channel of the network ({channels}), got "
            f"{printable(repr(option))}."
        ) from error
    ranges = ranges * (channels // len(ranges))
    return () if set(ranges) == {UNIT} else ranges


def require_ranges(ranges: Iterable[tuple[float, ...]]) -> None:
    """Raise ValueError if a pair is not a valid range (see `is_range`).

    Args:
        ranges: pairs (low, high) in the network's units.

    Raises:
        ValueError: low is not below high, or the larger absolute value is outside SIZES.
    """
    for low, high in ranges:
        if not is_range(low, high):
            raise ValueError(f"a range of {low:g} to {high:g}")


def is_range(low: float, high: float) -> bool:
    """Return True if two numbers can be the ends of a channel's input range.

    The lower end must be below the higher one, and the larger absolute value of the two must be
    within SIZES.
    """
    # NaN fails every comparison, so it is refused as well.
    return low < high and SIZES[0] <= largest_size(low, high) <= SIZES[1]


def largest_size(low: float, high: float) -> float:
    """Return the larger absolute value of the two ends of a range."""
    return max(abs(low), abs(high))


def ranges_of(images: Iterable[np.ndarray]) -> Ranges:
    """Return the ranges that images span.

    A channel whose values are in [0, 1], but for rounding, gets [0, 1], whatever part of it they
    cover. Another channel reaches from its smallest value, or 0, to its largest, or 0. Codes of a
    degradation have channels of 0 whose values are as small as -1e-7, and no scale fits those.

    Args:
        images: at least one image (1, C, H, W) in the network's units.

    Returns:
        One pair for each channel; empty if all are [0, 1].
    """
    ends = [(image.min((0, 2, 3)), image.max((0, 2, 3))) for image in images]
    low = np.minimum.reduce([low for low, _ in ends])
    high = np.maximum.reduce([high for _, high in ends])
    ranges = tuple(
        UNIT if a > -SIZES[0] and b <= LARGEST else (min(float(a), 0.0), max(float(b), 0.0))
        for a, b in zip(low, high, strict=True)
    )
    return () if set(ranges) == {UNIT} else ranges


def ranges_of_result(result: np.ndarray, image: np.ndarray, ranges: Ranges) -> Ranges:
    """Return the ranges relative to which a network's result is compared, so that 1 is full scale.

    1. A network may read normalised pixels and return an image in [0, 1], of which shares of the
       input's range would hide errors: such a result has the range [0, 1].
    2. Maps that are no image, such as a detector's, have a unit of their own. If they have more
       channels than the image, and most of their values lie outside its ranges, they reach from
       their smallest to their largest value. A network that returns fewer may read side maps.
    3. Any other result has the ranges of the image's channels.

    Args:
        result: the result of the float network, (1, C', H', W').
        image: the image (1, C, H, W) from which the result was computed.
        ranges: the range (low, high) of each channel of the image; empty if all are in [0, 1].
    """
    if share_within(result, *AROUND_UNIT) >= NEARLY_ALL:
        return ranges if share_within(image, *AROUND_UNIT) >= NEARLY_ALL else ()
    if result.shape[1] <= image.shape[1]:
        return ranges
    is_of_image = share_within(to_shares(result, ranges), *AROUND_UNIT) >= MOST
    low = float(result.min())
    high = float(result.max())
    return ranges if is_of_image or not is_range(low, high) else ((low, high),)


def share_within(values: np.ndarray, low: float, high: float) -> float:
    """Return the share of the values, in [0, 1], that lie from `low` to `high`, both included."""
    return float(((values >= low) & (values <= high)).mean())


def to_shares(values: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return values as shares of the ranges: low becomes 0 and high becomes 1.

    Args:
        values: images or results (..., C, H, W) in the network's units.
        ranges: the ranges of the image's channels; empty returns `values` itself.
    """
    if not ranges:
        return values
    low, high = _ends(values, ranges)
    return np.asarray((values - low) / (high - low))


def from_shares(shares: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return the values that have these shares of the ranges. This is the inverse of `to_shares`.

    Args:
        shares: images or results (..., C, H, W), where 0 is low and 1 is high.
        ranges: the ranges of the image's channels; empty returns `shares` itself.
    """
    if not ranges:
        return shares
    low, high = _ends(shares, ranges)
    return np.asarray(low + shares * (high - low))


def _ends(values: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return low and high (2, C, 1, 1) float32 of the channels of values.

    Args:
        values: images or results (..., C, H, W).
        ranges: the ranges of the image's channels, at least one.
    """
    channels = values.shape[-3]
    # A result has the ranges of the image's first channels, because a map of noise levels comes
    # last. A result with more channels than the image has the range of the first.
    ends = ranges[:channels] if channels <= len(ranges) else ranges[:1]
    return np.array(ends, np.float32).T[:, :, None, None]


def in_words(ranges: Ranges) -> str:
    """Format ranges as text for messages, such as "-1 to 1".

    Args:
        ranges: the ranges of a network's channels, at least one. They are stated once if all are
            equal.
    """
    return ", ".join(
        f"{low:g} to {high:g}" for low, high in (ranges if len(set(ranges)) > 1 else ranges[:1])
    )
