"""The ranges of a network's input, where its channels are not all in [0, 1].

A network may read pixels of 0 to 255, normalised ones such as (x - 0.485) / 0.229, or a map of
noise levels next to the image. Images and samples have the network's own units; figures are shares
of a range, so that 1 is full scale for every network.
"""

from collections.abc import Iterable

import numpy as np

from beers_deploy.profiles.errors import OptionError, printable

Ranges = tuple[tuple[float, float], ...]
"""(low, high) of each channel of the image; empty where all are in [0, 1]."""

UNIT = (0.0, 1.0)
KEY = "input_range"
"""Of the metadata of an INT8 file: the ranges in words, and whether samples alone tell them."""
FROM_SAMPLES = "found in the samples"
LARGEST = 1 + 1e-6
"""The largest share of a range that counts as 1: rounding may have left it above."""
SIZES = 1e-6, 65536.0
"""The smallest and the largest size of the end of a range."""


def read_ranges(option: object, channels: int) -> Ranges:
    """Return the ranges that a user states: LOW,HIGH or such a pair for each channel.

    Raises:
        OptionError: other text, another number of pairs, or ends that are no range.
    """
    try:
        numbers = option.split(",") if isinstance(option, str) else np.ravel(option)  # type: ignore[call-overload]
        pairs = np.array(numbers, float).reshape(-1, 2)
        if len(pairs) not in (1, channels):
            raise ValueError(f"{len(pairs)} pairs")
        ranges = tuple((float(low), float(high)) for low, high in pairs)
        require_ranges(ranges)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"`input_range` must be LOW,HIGH with LOW below HIGH and sizes up to {SIZES[1]:g}, or "
            f"such a pair for each of the network's {channels} channels, got "
            f"{printable(repr(option))}."
        ) from error
    ranges = ranges * (channels // len(ranges))
    return () if set(ranges) == {UNIT} else ranges


def require_ranges(ranges: Iterable[tuple[float, ...]]) -> None:
    """Raise ValueError if a pair is no range, or of no sensible size."""
    for low, high in ranges:
        if not is_range(low, high):
            raise ValueError(f"a range of {low:g} to {high:g}")


def is_range(low: float, high: float) -> bool:
    """Return True if low is below high, and neither is too large."""
    # NaN fails every comparison, so it is refused as well.
    return low < high and SIZES[0] <= largest_size(low, high) <= SIZES[1]


def largest_size(low: float, high: float) -> float:
    """Return the size of the end of a range that is farther from 0."""
    return max(abs(low), abs(high))


def ranges_of(images: Iterable[np.ndarray]) -> Ranges:
    """Return the ranges that images (1, C, H, W) span: a channel in [0, 1] has all of that, and any
    other one reaches from its smallest value, or 0, to its largest.
    """
    ends = [(image.min((0, 2, 3)), image.max((0, 2, 3))) for image in images]
    low = np.minimum.reduce([low for low, _ in ends])
    high = np.maximum.reduce([high for _, high in ends])
    ranges = tuple(
        UNIT if a >= 0 and b <= LARGEST else (min(float(a), 0.0), max(float(b), 0.0))
        for a, b in zip(low, high, strict=True)
    )
    return () if set(ranges) == {UNIT} else ranges


def to_shares(values: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return images or results (..., C, H, W) as shares of the ranges: low is 0 and high is 1."""
    if not ranges:
        return values
    low, high = _ends(values, ranges)
    return np.asarray((values - low) / (high - low))


def from_shares(shares: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return the values of which `to_shares` makes these shares."""
    if not ranges:
        return shares
    low, high = _ends(shares, ranges)
    return np.asarray(low + shares * (high - low))


def _ends(values: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return low and high (2, C, 1, 1) float32 of the channels of values."""
    channels = values.shape[-3]
    # A result has the ranges of the image's first channels, because a map of noise levels comes
    # last. One of more channels than the image has the range of the first.
    ends = ranges[:channels] if channels <= len(ranges) else ranges[:1]
    return np.array(ends, np.float32).T[:, :, None, None]


def in_words(ranges: Ranges) -> str:
    """Return ranges as messages state them, once where all are equal."""
    return ", ".join(
        f"{low:g} to {high:g}" for low, high in (ranges if len(set(ranges)) > 1 else ranges[:1])
    )
