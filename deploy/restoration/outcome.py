"""Compare a restored image with its raw image, so that a network of another scale does not write a
white image.

A restoration preserves the mean and most of the contrast, and leaves few pixels at 0 or at full
scale. Small departures give a warning. Departures that no restoration has are refused.
"""

import math
from dataclasses import astuple, dataclass, replace
from operator import add
from typing import Annotated

import numpy as np
from annotated_types import Ge
from pydantic import StrictFloat, StrictInt

from beers_deploy.model.family import RANGES
from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.figures import Figure, measured

MANY_AT_ENDS = 0.9
FAR = 0.5
FLAT = 0.001
FEW = 1000
"""A result is refused if a larger share of it is at 0 or full scale, if its mean moved by a larger
share of full scale, or if less of the contrast is left. Images of fewer pixels are never refused.
"""
SOME_AT_ENDS = 0.05
"""A warning reports a larger share of the results at 0 or full scale."""
BLANK_PX = 8
MANY_BLANK = 0.01
"""A warning reports a larger share of the image in squares of `BLANK_PX` a side that are exactly 0,
if no pixel is stated to be missing. Noise leaves no such square, even around 0.
"""
MEAN_SHARE = 0.015
LEAST_MOVE = 0.0003
SCATTER = 2.0
DARK_MOVE = RANGES["sigma_dark"][1] / 2
"""A warning reports a mean that moved by more than the sum of these shares: of itself; of full
scale (1 DN of 12 bits); of the standard error of the mean, since a border of zeros changes a small
image; and of full scale, for the dark part.

A detector stores no value below 0, which raises the mean of a dark, noisy image, and a network adds
up to half a standard deviation of the noise to that. Of 443 restorations by the shipped networks,
of 24 px and more a side, at 1 to 1/500 of the light, none reached 0.75 of the bound (measured).
"""
DARK = 3 * RANGES["sigma_dark"][1]
"""Pixels below this share of full scale lie within three standard deviations of the noisiest
sensor's noise, which clipping at 0 can reach.
"""
LEAST_SPREAD = 1e-6
"""Standard deviation, as a share of full scale, up to which an image counts as constant."""


Count = Annotated[StrictInt, Ge(0)]
Sum = Annotated[StrictFloat | StrictInt, Ge(0)]
"""The numbers of a tally, which pydantic checks if they are read from a file."""


@dataclass(frozen=True)
class Tally:
    """Counts and sums over raw pixels and their results, the restored pixels, without missing ones.

    There is one tally for each tile; the sum of two is the tally of both parts of the image. Pixel
    values are shares of full scale.

    Attributes:
        valid_results: number of results that are not missing.
        clipped: number of raw pixels above full scale.
        at_ends: number of results at 0 or at full scale where the raw pixel lies between.
        compared: number of raw pixels in the sums; 0 if the network returns other bands.
        before: sum of the raw pixels, clipped to full scale.
        before_squared: sum of the squares of these raw pixels.
        after: sum of the results.
        after_squared: sum of the squares of the results.
        tiles: number of tiles that the network was run on.
        runs: number of runs of the network. A tile needs several if dark parts of it are multiplied
            by a factor above 1 before the network (an exposure).
        brightened: number of results that were restored at a factor above 1.
        change_squared: sum of the squared changes by the consistency step, which makes the
            network's results agree with the raw image at low spatial frequencies.
        network_at_ends: `at_ends` before the consistency step. The step would hide a network that
            does not fit, since it gives nearly any image the mean and the coarse structure of the
            raw one.
        network_after: `after` before the consistency step.
        network_after_squared: `after_squared` before the consistency step.
        dark: number of raw pixels that noise may take to 0.
        blank: number of raw pixels in squares of 8 x 8 that are exactly 0.
    """

    valid_results: Count = 0
    clipped: Count = 0
    at_ends: Count = 0
    compared: Count = 0
    before: Sum = 0.0
    before_squared: Sum = 0.0
    after: Sum = 0.0
    after_squared: Sum = 0.0
    tiles: Count = 0
    runs: Count = 0
    brightened: Count = 0
    change_squared: Sum = 0.0
    network_at_ends: Count = 0
    network_after: Sum = 0.0
    network_after_squared: Sum = 0.0
    dark: Count = 0
    blank: Count = 0

    @classmethod
    def of(
        cls,
        stored: np.ndarray,
        restored: np.ndarray,
        valid: np.ndarray | None,
        valid_restored: np.ndarray | None,
    ) -> "Tally":
        """Compute the tally of a part of an image, from its raw and restored pixels.

        Args:
            stored: the raw pixels (bands, h, w), in shares of full scale.
            restored: the restored pixels (bands', h s, w s), in shares of full scale and rounded as
                they are stored, where s is the network's scale.
            valid: mask of the raw pixels that are not missing; None if none is missing.
            valid_restored: mask of the restored pixels that are not missing; None if none is.
        """
        alike = len(stored) == len(restored)
        at_ends = (restored <= 0) | (restored >= 1)
        if alike:
            scale = restored.shape[1] // stored.shape[1]
            between = (stored > 0) & (stored < 1)
            at_ends &= between.repeat(scale, axis=1).repeat(scale, axis=2)
        before = stored
        after = restored
        if valid is not None and valid_restored is not None:
            at_ends = at_ends & valid_restored
            before = stored[valid]
            after = restored[valid_restored]
        ends = int(at_ends.sum())
        blank = 0
        if valid is None:
            # Whole squares of `BLANK_PX` that are 0.
            bands, height, width = stored.shape
            rows = height // BLANK_PX
            columns = width // BLANK_PX
            whole = stored[:, : rows * BLANK_PX, : columns * BLANK_PX]
            squares = whole.reshape(bands, rows, BLANK_PX, columns, BLANK_PX)
            blank = int((squares == 0).all(axis=(2, 4)).sum()) * BLANK_PX**2
        counts = cls(after.size, int((before > 1).sum()), ends, network_at_ends=ends, blank=blank)
        if not alike:
            return counts
        before = np.minimum(before, 1)
        total = float(after.sum())
        squared = float((after**2).sum())
        return replace(
            counts,
            compared=before.size,
            before=float(before.sum()),
            before_squared=float((before**2).sum()),
            after=total,
            after_squared=squared,
            network_after=total,
            network_after_squared=squared,
            dark=int((before < DARK).sum()),
        )

    def __add__(self, other: "Tally") -> "Tally":
        return Tally(*map(add, astuple(self), astuple(other)))

    @property
    def network(self) -> "Tally":
        """The tally of the network's results, before the consistency step."""
        return replace(
            self,
            at_ends=self.network_at_ends,
            after=self.network_after,
            after_squared=self.network_after_squared,
            change_squared=0.0,
        )

    @property
    def share_at_ends(self) -> float:
        """The share of the results that are 0 or full scale where the raw pixel lies between."""
        return self.at_ends / max(self.valid_results, 1)

    @property
    def means(self) -> tuple[float, float]:
        """The mean of the raw pixels and of the results, in shares of full scale; both are 0 if the
        network returns other bands.
        """
        return self.before / max(self.compared, 1), self.after / max(self.valid_results, 1)

    @property
    def moved(self) -> float:
        """The mean of the results minus that of the raw pixels, in shares of full scale."""
        return self.means[1] - self.means[0]

    @property
    def mean_bound(self) -> float:
        """The largest change of the mean that gives no warning, in shares of full scale."""
        count = max(self.compared, 1)
        # A border of zeros changes the mean of a small image, hence the standard error.
        scatter = SCATTER * self.spreads[0] / math.sqrt(count)
        # No pixel is stored below 0, which raises the mean of a dark and noisy image.
        return MEAN_SHARE * self.means[0] + LEAST_MOVE + scatter + DARK_MOVE * self.dark / count

    @property
    def spreads(self) -> tuple[float, float]:
        """The standard deviation of the raw pixels and of the results, in shares of full scale."""
        before, after = self.means
        # Rounding may leave the mean square below the square of the mean.
        variance_before = max(self.before_squared / max(self.compared, 1) - before**2, 0)
        variance_after = max(self.after_squared / max(self.valid_results, 1) - after**2, 0)
        return math.sqrt(variance_before), math.sqrt(variance_after)

    @property
    def flat(self) -> bool:
        """True if the results are constant (less than `FLAT` of the contrast is left) and the raw
        image is not.
        """
        before, after = self.spreads
        return before > LEAST_SPREAD and after < FLAT * before

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures of every run, by name: raw pixels above full scale, results at 0 or full
        scale, and the change of the mean.
        """
        ends = "results at 0 or full scale where the image is not"
        mean = "mean of the known pixels, after less before"
        return {
            "clipped pixels": measured(
                self.clipped, "1", "pixels of the image above its full scale"
            ),
            "results at ends": measured(100 * self.share_at_ends, "%", ends),
            "mean moved": measured(100 * self.moved, "% of full scale", mean),
        }

    @property
    def nearly_all_clipped(self) -> bool:
        """True if nearly all raw pixels are above full scale."""
        return self.clipped > MANY_AT_ENDS * max(self.compared, 1)

    @property
    def doubts(self) -> list[str]:
        """The warnings on an implausible result, one clause each; empty for a plausible one. They
        look at the network's results before the consistency step.
        """
        clauses = []
        # The consistency step gives nearly any image the mean of the raw one, and so would hide
        # a network that does not fit.
        network = self.network
        before = "before the consistency step, " if self.change_squared else ""
        if self.nearly_all_clipped:
            clauses.append(f"{self.clipped} pixels of the image, nearly all, are above full scale")
        if network.share_at_ends > SOME_AT_ENDS:
            share = f"{network.share_at_ends:.0%} of the results"
            clauses.append(f"{before}{share} are 0 or full scale where the image is not")
        if abs(network.moved) > network.mean_bound:
            clauses.append(
                before + "the mean went from {:.3g} to {:.3g} of full scale".format(*network.means)
            )
        if self.blank > MANY_BLANK * max(self.compared, 1):
            clauses.append(
                f"{self.blank} pixels of the image lie in areas that are exactly 0 and bleed into "
                "their surroundings; if they are missing, state it (gdal_edit.py -a_nodata 0)"
            )
        if network.flat:
            clauses.append(f"{before}the results are constant and the image is not")
        return clauses

    def require(self, name: str) -> None:
        """Raise ImageError if the results differ from the raw image as no restoration does.

        At least `FEW` results are refused if nearly all of them are 0 or full scale, if nearly all
        raw pixels are above full scale, if the mean moved by more than half of full scale, or if
        the results are constant and the raw image is not.

        Args:
            name: the name of the image, for the message.
        """
        network = self.network
        impossible = (
            network.share_at_ends > MANY_AT_ENDS
            or abs(network.moved) > FAR
            or network.flat
            or self.nearly_all_clipped
        )
        if self.valid_results >= FEW and impossible:
            raise ImageError(
                f"{name} has no plausible restoration: "
                f"{printable('; '.join(self.doubts))}. Check `full_scale`, check the network with "
                "'gate', or write the result all the same with `force`."
            )
