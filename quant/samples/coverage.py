"""Determine which part of a sensor's range a set of samples covers.

A limit is no evidence for brightness that no sample has. `quantize` therefore records the range of
the calibration samples, and the gate prints the range of its own samples.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np

from beers_deploy.profiles.figures import Row, measured
from beers_deploy.profiles.user_files.json_text import parse_json

KEY = "calibration_range"
"""The metadata key in an INT8 file."""

BINS = 4096
"""The number of bins of the histogram over [0, 1]: one for each digital number of 12 bits.

Pixels in the last bin are saturated.
"""

SHARES = (0.01, 0.5, 0.99, 0.999)
"""The shares of the percentiles that describe a range."""

COVERED = 0.9
"""Samples whose 99.9th percentile lies at this share of full scale cover bright ground."""


@dataclass(frozen=True)
class SampleRange:
    """The part of a sensor's brightness range that a set of samples covers.

    Attributes:
        p1: the 1st percentile of all pixels, as a share of full scale.
        p50: the median of all pixels.
        p99: the 99th percentile.
        p99_9: the 99.9th percentile.
        saturated: the share of the pixels that lie in the last bin of the histogram.
    """

    p1: float
    p50: float
    p99: float
    p99_9: float
    saturated: float

    @property
    def reaches_full_scale(self) -> bool:
        """True if the samples cover bright ground: their 99.9th percentile is at least COVERED."""
        return self.p99_9 >= COVERED

    def __str__(self) -> str:
        return (
            f"1, 50, 99 and 99.9 % of the pixels lie below {self.p1:.3f}, {self.p50:.3f}, "
            f"{self.p99:.3f} and {self.p99_9:.3f} of full scale, {100 * self.saturated:.3g} % are "
            "saturated"
        )

    def to_words(self) -> str:
        """Return the range as JSON text for the metadata of an INT8 file, which `recorded_range`
        reads.
        """
        return json.dumps({name: round(value, 6) for name, value in asdict(self).items()})

    def row(self, name: str, source: str) -> Row:
        """Return the range as a row of the table "samples".

        Args:
            name: the name of the row.
            source: how the samples were obtained, for the figures.
        """
        figures = {
            "1st percentile": measured(self.p1, "of full scale", source),
            "median": measured(self.p50, "of full scale", source),
            "99th percentile": measured(self.p99, "of full scale", source),
            "99.9th percentile": measured(self.p99_9, "of full scale", source),
            "saturated": measured(100 * self.saturated, "%", source),
        }
        return Row("samples", name, figures)


def histogram(sample: np.ndarray) -> np.ndarray:
    """Count the pixels of a sample by value, in BINS bins over [0, 1].

    Args:
        sample: values in [0, 1] of any shape.

    Returns:
        (BINS,) counts; the last bin also holds the value 1.
    """
    # The value 1 would open a bin of its own, so it is clipped to the last.
    bins = np.clip(sample * np.float32(BINS), 0, BINS - 1).astype(np.int64)
    return np.bincount(bins.ravel(), minlength=BINS)


def range_from(counts: np.ndarray) -> SampleRange:
    """Compute the percentiles and the saturated share of samples from their histogram.

    Args:
        counts: (BINS,) the sum of the histograms of all samples, as `histogram` returns them.
    """
    shares = np.cumsum(counts) / counts.sum()
    # The numbers of the bins are digital numbers, and the last of them is full scale.
    p1, p50, p99, p99_9 = (np.searchsorted(shares, SHARES) / (BINS - 1)).tolist()
    return SampleRange(p1, p50, p99, p99_9, float(counts[-1] / counts.sum()))


def recorded_range(about: Mapping[str, str]) -> SampleRange | None:
    """Return the brightness range of the calibration samples that an INT8 file records in its
    metadata.

    It is the file's own claim, which nothing verifies: it may be shown, but no check may depend on
    it.

    Args:
        about: the metadata of the file.

    Returns:
        The range; None if none is recorded, or if the numbers cannot be percentiles.
    """
    try:
        # Wrong names are a TypeError of the constructor.
        values: Any = parse_json(about.get(KEY, ""))
        record = SampleRange(**{name: float(value) for name, value in values.items()})
    except (ValueError, TypeError, AttributeError):
        return None
    *percentiles, saturated = astuple(record)
    plausible = all(math.isfinite(value) and 0 <= value <= 1 for value in (*percentiles, saturated))
    # Percentiles rise by definition; others were not computed from any image.
    return record if plausible and percentiles == sorted(percentiles) else None


def uncovered(judged: SampleRange, calibrated: SampleRange | None) -> str:
    """Return a sentence for the user if the samples of a gate leave out bright ground; else an
    empty string.

    Args:
        judged: the brightness range of the gate's samples.
        calibrated: the range that the INT8 file records for its calibration; None if it records
            none.
    """
    if judged.reaches_full_scale:
        return ""
    sentence = (
        f"the samples reach {judged.p99_9:.2f} of full scale (99.9th percentile): "
        "nothing brighter was judged"
    )
    if calibrated is None or calibrated.reaches_full_scale:
        return sentence
    reached = f"{calibrated.p99_9:.2f}"
    return f"{sentence}, and by the INT8 file's own record its calibration reached {reached}"
