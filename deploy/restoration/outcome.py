"""What comes out of a restoration, held against what went in: a network of another scale writes no
white image.

A restoration keeps the mean, most of the contrast, and leaves few pixels at an end of full scale.
Small departures are told, those that no restoration has are refused.
"""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from operator import add

import numpy as np

from beers_deploy.model.family import RANGES
from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.figures import Figure, measured

MANY_AT_ENDS = 0.9
FAR = 0.5
FLAT = 0.001
FEW = 1000
"""Refused: more of the results at an end of full scale, a mean moved by more of it, less contrast
left; of fewer pixels nothing is.
"""
SOME_AT_ENDS = 0.05
"""Told: more of the results at an end."""
BLANK_PX = 8
MANY_BLANK = 0.01
"""Told: more of the image in squares of so many pixels a side that are exactly 0, while no pixel is
stated to be missing. Noise leaves no such square, even around 0.
"""
MEAN_KEPT = 0.015
LEAST_MOVE = 0.0003
SCATTER = 2.0
DARK_MOVE = RANGES["sigma_dark"][1] / 2
"""Told: a mean moved by more than the sum of these shares: of itself; of full scale (1 DN of 12
bits); of the standard error of the mean, since a border of zeros changes a small image; and of full
scale, for the dark part.

A detector stores no value below 0, which raises the mean of a dark, noisy image, and a network adds
up to half a standard deviation of the noise to that. Of 443 restorations by the shipped networks,
of 24 px and more a side, at 1 to 1/500 of the light, none reached 0.75 of the bound (measured).
"""
DARK = 3 * RANGES["sigma_dark"][1]
"""Of full scale: within three standard deviations of the loudest sensor's noise, which clipping at
0 can reach.
"""
LEAST_SPREAD = 1e-6
"""Of an image that is constant but for rounding, in shares of full scale."""


@dataclass(frozen=True)
class Tally:
    """What was seen of an image and of its result where both are known: counts, and sums in shares
    of full scale.

    Attributes:
        known: results that are no missing pixels.
        clipped: pixels of the image above full scale.
        at_ends: results that came to 0 or to full scale where the image lay between.
        compared: pixels of the image that the sums count; none where the network makes other bands
            of them.
        before: sum of these pixels.
        before_squared: of their squares.
        after: sum of the results.
        after_squared: of their squares.
        tiles: tiles that the network was run on.
        runs: of the network, one for each exposure that a tile asks for.
        brightened: results that were restored at an exposure above 1.
        change_squared: sum of the squares of what the consistency step changed.
        network_at_ends: as `at_ends`, of what the network gave. The consistency step would hide a
            network that does not fit, since it gives nearly any image the mean and the coarse
            structure of the raw one.
        network_after: as `after`, of what the network gave.
        network_after_squared: as `after_squared`, of what the network gave.
        dark: pixels of the image that noise may take to 0.
        blank: pixels of the image in squares of 8 x 8 that are exactly 0.
    """

    known: int = 0
    clipped: int = 0
    at_ends: int = 0
    compared: int = 0
    before: float = 0.0
    before_squared: float = 0.0
    after: float = 0.0
    after_squared: float = 0.0
    tiles: int = 0
    runs: int = 0
    brightened: int = 0
    change_squared: float = 0.0
    network_at_ends: int = 0
    network_after: float = 0.0
    network_after_squared: float = 0.0
    dark: int = 0
    blank: int = 0

    @classmethod
    def of(
        cls,
        stored: np.ndarray,
        restored: np.ndarray,
        seen: np.ndarray | None,
        known: np.ndarray | None,
    ) -> "Tally":
        """Of a part of an image.

        Args:
            stored: its pixels (bands, h, w), in shares of full scale.
            restored: its results, of as many or other bands, of so many times as many rows and
                columns.
            seen: which pixels are known; None for all.
            known: which results are; None for all.
        """
        alike = len(stored) == len(restored)
        between = (stored > 0) & (stored < 1)
        scale = restored.shape[1] // stored.shape[1]
        within = between.repeat(scale, axis=1).repeat(scale, axis=2) if alike else True
        at_ends = ((restored <= 0) | (restored >= 1)) & within
        before = stored
        after = restored
        if seen is not None and known is not None:
            at_ends = at_ends & known
            before = stored[seen]
            after = restored[known]
        ends = int(at_ends.sum())
        blank = 0 if seen is not None else _blank_px(stored)
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

    def changed_from(self, network: "Tally", change_squared: float) -> "Tally":
        """Return this tally of pixels that the consistency step made of those that `network` is the
        tally of.
        """
        return replace(
            self,
            change_squared=change_squared,
            network_at_ends=network.at_ends,
            network_after=network.after,
            network_after_squared=network.after_squared,
        )

    def __add__(self, other: "Tally") -> "Tally":
        return Tally(*map(add, astuple(self), astuple(other)))

    @property
    def network(self) -> "Tally":
        """The tally of what the network gave, before the consistency step."""
        return replace(
            self,
            at_ends=self.network_at_ends,
            after=self.network_after,
            after_squared=self.network_after_squared,
            change_squared=0.0,
        )

    @property
    def share_at_ends(self) -> float:
        """Of the results, those at an end of full scale where the image lay between."""
        return self.at_ends / max(self.known, 1)

    @property
    def means(self) -> tuple[float, float]:
        """Before and after, in shares of full scale; 0 where they cannot be compared."""
        return self.before / max(self.compared, 1), self.after / max(self.known, 1)

    @property
    def moved(self) -> float:
        """By how much the mean moved."""
        return self.means[1] - self.means[0]

    @property
    def mean_bound(self) -> float:
        """By how much a restoration may move the mean."""
        count = max(self.compared, 1)
        # A border of zeros changes the mean of a small image, hence the standard error.
        scatter = SCATTER * self.spreads[0] / math.sqrt(count)
        # No pixel is stored below 0, which raises the mean of a dark and noisy image.
        return MEAN_KEPT * self.means[0] + LEAST_MOVE + scatter + DARK_MOVE * self.dark / count

    @property
    def spreads(self) -> tuple[float, float]:
        """Standard deviation before and after, in shares of full scale."""
        before, after = self.means
        before_square = self.before_squared / max(self.compared, 1)
        after_square = self.after_squared / max(self.known, 1)
        # Rounding may leave the mean square below the square of the mean.
        return math.sqrt(max(before_square - before**2, 0)), math.sqrt(
            max(after_square - after**2, 0)
        )

    @property
    def flat(self) -> bool:
        """Whether the results are constant and the image is not."""
        before, after = self.spreads
        return before > LEAST_SPREAD and after < FLAT * before

    @property
    def figures(self) -> Mapping[str, Figure]:
        """For the results of a run."""
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
    def exposure_figures(self) -> Mapping[str, Figure]:
        """What several exposures of the network were used for, for the results of a run."""
        runs = "exposures that tiles asked for, mean of the tiles"
        pixels = "restored at an exposure above 1"
        share = 100 * self.brightened / max(self.known, 1)
        return {
            "network runs": measured(self.runs / max(self.tiles, 1), "run/tile", runs),
            "brightened pixels": measured(share, "%", pixels),
        }

    @property
    def consistency_figures(self) -> Mapping[str, Figure]:
        """What the consistency step changed, for the results of a run."""
        rms = math.sqrt(self.change_squared / max(self.known, 1))
        source = "root mean square of what the step added to the known pixels"
        return {"consistency step": measured(100 * rms, "% of full scale", source)}

    @property
    def doubts(self) -> list[str]:
        """What a user should look at, a clause each; of the network's results, before the
        consistency step.
        """
        clauses = []
        # The consistency step gives nearly any image the mean of the raw one, and so would hide
        # a network that does not fit.
        network = self.network
        before = "before the consistency step, " if self.change_squared else ""
        if self.clipped > MANY_AT_ENDS * max(self.compared, 1):
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
        """Refuse what no restoration gives of an image, `name` in messages."""
        network = self.network
        impossible = (
            network.share_at_ends > MANY_AT_ENDS or abs(network.moved) > FAR or network.flat
        )

        if self.known >= FEW and (
            impossible or self.clipped > MANY_AT_ENDS * max(self.compared, 1)
        ):
            raise ImageError(
                f"{name} is not restored plausibly: {printable('; '.join(self.doubts))}. Check "
                "`full_scale` and, with 'gate', the network, or write the result all the same with "
                "`force`."
            )


def _blank_px(stored: np.ndarray) -> int:
    """Return how many pixels (bands, h, w) lie in whole squares of `BLANK_PX` that are 0."""
    bands, height, width = stored.shape
    rows = height // BLANK_PX
    columns = width // BLANK_PX
    whole = stored[:, : rows * BLANK_PX, : columns * BLANK_PX]
    squares = whole.reshape(bands, rows, BLANK_PX, columns, BLANK_PX)
    return int((squares == 0).all(axis=(2, 4)).sum()) * BLANK_PX**2
