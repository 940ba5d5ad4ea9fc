"""Detect faults of detectors in strips of an image: gains of columns and rows, dead lines, wrong
single pixels.

Restoration sharpens isolated deviations: a column whose gain is off by 1 % comes out off by almost
2 %. Therefore `restore` warns of it, and `restore --dry-run` shows the faults found. The strips
span the whole width and are spread evenly from top to bottom. In a large image they cover
`CHECKED_PX` pixels of all bands together.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import NamedTuple

import numpy as np

from beers_deploy.model.metrics.detector_lines import LineBlocks, join_blocks, measure_lines
from beers_deploy.model.metrics.detector_phases import (
    COLOUR,
    Pattern,
    judge_phases,
    measure_phases,
)
from beers_deploy.model.metrics.detector_pixels import wrong_pixels
from beers_deploy.model.metrics.detector_stripes import Stripes, judge_lines
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.restoration.detectors.fault_list import FOUND

logger = logging.getLogger(__name__)

CHECKED_PX = 1 << 23
"""The number of pixels, over all bands, that are checked. This takes one to two seconds on one core
(measured).
"""
STRIP_PX = 128
LEAST_STRIP_PX = 16
LEAST_ROWS_PX = 64
"""The number of rows of a strip, its minimum, and the minimum of all strips together."""
MARGIN_PX = 4
"""The number of rows around a strip with which its rows and pixels are compared."""
BLOCKS = 8
SECTION_PX = 32
"""The number of blocks along a line, and the minimum width of a section of a strip."""
LEAST = 0.003
"""The smallest relevant relative gain error of a column, and the smallest relevant pattern of two
pixels.
"""


@dataclass(frozen=True)
class BandFaults:
    """The faults of detectors that were found in strips of one band of an image.

    Attributes:
        columns: the columns with a wrong gain and the dead ones, by their number in the image.
        rows: the rows with a wrong gain and the dead ones among those in the strips, by their
            number in the image.
        patterns: the fixed patterns that repeat after two pixels, such as a checkerboard.
        pixels: row and column in the image, (n, 2), of single wrong pixels in the strips.
        checked_px: the number of pixels in the strips that are not missing.
    """

    columns: Stripes
    rows: Stripes
    patterns: tuple[Pattern, ...]
    pixels: np.ndarray
    checked_px: int


def faults_in_strips(source: Source, full_scale: float = np.inf) -> tuple[BandFaults, ...]:
    """Detect faults of detectors in strips of an image that are spread from top to bottom.

    Args:
        source: the image.
        full_scale: the pixel value at and above which a pixel is saturated and does not count; by
            default all pixels count.

    Returns:
        The faults of each band, in the order of the bands.
    """
    raster = source.raster
    steps = value_steps(source)
    strips: list[list[StripMeasures]] = [[] for _ in steps]
    rows_px = max(CHECKED_PX // (raster.width_px * raster.bands), LEAST_ROWS_PX)
    rows_px = min(raster.height_px, rows_px)
    side_px = min(STRIP_PX, max(LEAST_STRIP_PX, rows_px // BLOCKS), raster.height_px)
    for place in np.linspace(0, raster.height_px - side_px, max(rows_px // side_px, 1)):
        # The patterns have a period of 2: strips that begin on even rows share its phase.
        top = int(place) // 2 * 2
        stop = top + side_px
        start = max(top - MARGIN_PX, 0)
        end = min(stop + MARGIN_PX, raster.height_px)
        within = slice(top - start, stop - start)
        for band, pixels in enumerate(as_floats(raster, source.read(start, end))):
            strips[band].append(_measured(start, within, pixels, steps[band], full_scale))
    return tuple(map(_judged, strips))


def as_floats(raster: Raster, stored: np.ndarray) -> np.ndarray:
    """Convert pixels as stored to float32, with NaN where they are missing or not finite.

    Args:
        raster: the description of the image, which states how missing pixels are marked.
        stored: pixels (bands, h, w) of the image, masked or not.
    """
    with np.errstate(over="ignore"):
        pixels = np.ma.getdata(stored).astype(np.float32)
    pixels[raster.missing(stored) | ~np.isfinite(pixels)] = np.nan
    return pixels


def value_steps(source: Source) -> list[float]:
    """Return the step between the pixel values of each band: the largest integer that divides all
    of them in some rows in the middle.

    The step is 64 if the file stores values of 10 bits as multiples of 64 in 16 bits, usually 1 for
    other integers, and 0 for floats.
    """
    raster = source.raster
    if raster.dtype.kind == "f":
        return [0.0] * raster.bands

    top = raster.height_px // 2
    rows = np.ma.getdata(source.read(top, min(top + LEAST_STRIP_PX, raster.height_px)))
    return [float(max(int(np.gcd.reduce(band.astype(np.int64), axis=None)), 1)) for band in rows]


class StripMeasures(NamedTuple):
    """The measurements in one strip of a band.

    Attributes:
        columns: the measurements of the columns.
        rows: the measurements of the rows.
        numbers: the numbers of the rows in the image.
        phases: the patterns of two pixels, one for each section.
        pixels: row and column in the image, (n, 2), of wrong pixels.
        checked_px: the number of pixels that are not missing.
    """

    columns: LineBlocks
    rows: LineBlocks
    numbers: range
    phases: list[tuple[np.ndarray, np.ndarray]]
    pixels: np.ndarray
    checked_px: int


def _measured(
    top: int, within: slice, pixels: np.ndarray, step: float, full_scale: float
) -> StripMeasures:
    """Measure a strip of a band.

    Args:
        top: the row of the image at which `pixels` begins.
        within: the rows of `pixels` that are checked; the rows around are for comparison.
        pixels: (h, w), NaN where they are missing.
        step: the step between pixel values.
        full_scale: the value at and above which a pixel is saturated and does not count.
    """
    # The converter clips at 0 and at full scale, where a pixel no longer follows its gain.
    valid = (pixels > 0) & (pixels < full_scale)
    inner = valid[within]
    width_px = pixels.shape[1]
    count = min(max(width_px // SECTION_PX, 1), BLOCKS)
    # First columns are even, so that all sections share the phase of a pattern of two pixels.
    ends = [width_px * number // count // 2 * 2 for number in range(count)] + [width_px]
    rows = []
    phases = []
    for left, right in pairwise(ends):
        section = slice(left, right)
        rows.append(
            measure_lines(pixels[:, section].T.copy(), valid[:, section].T.copy()).of(within)
        )
        phases.append(measure_phases(pixels[within, section], inner[:, section]))
    places = wrong_pixels(pixels, step)
    inside = (places[:, 0] >= within.start) & (places[:, 0] < within.stop)
    return StripMeasures(
        columns=measure_lines(pixels[within], inner),
        rows=join_blocks(rows),
        numbers=range(top + within.start, top + within.stop),
        phases=phases,
        pixels=places[inside] + np.array([top, 0]),
        checked_px=int(np.isfinite(pixels[within]).sum()),
    )


def _judged(strips: Sequence[StripMeasures]) -> BandFaults:
    """Evaluate all strips of a band together, and return the faults of the band."""
    rows = judge_lines(join_blocks([strip.rows for strip in strips], axis=1), LEAST)
    return BandFaults(
        columns=judge_lines(join_blocks([strip.columns for strip in strips]), LEAST),
        rows=rows.renumbered(list(chain.from_iterable(strip.numbers for strip in strips))),
        patterns=judge_phases(list(chain.from_iterable(s.phases for s in strips)), LEAST),
        pixels=np.concatenate([strip.pixels for strip in strips]),
        checked_px=sum(strip.checked_px for strip in strips),
    )


SHARPENS = "restoration about doubles it"
EQUALIZE = "equalise the image first"
TRAIN = "or use a network that was trained with the effects prnu and dsnu"
FIX = f"; `fix_detectors` {FOUND} replaces such "
NAMED = 3
"""The largest number of places that a sentence names."""


def warn_of_detectors(source: Source, full_scale: float, advise_fix: bool) -> Mapping[str, Figure]:
    """Detect faults of detectors in strips of an image, and log a warning for each kind of fault.

    Args:
        source: the image.
        full_scale: the pixel value at and above which a pixel is saturated and does not count.
        advise_fix: False if the run replaces the faults that it finds, so that no warning
            recommends it.

    Returns:
        The figures of the faults by name, for a row of results.
    """
    bands = faults_in_strips(source, full_scale)
    for sentence in sentences(bands, advise_fix):
        logger.warning(sentence)
    return figures(bands)


def sentences(bands: Sequence[BandFaults], advise_fix: bool = True) -> list[str]:
    """Return the warnings on faults of detectors, one for each kind of fault in each band.

    Args:
        bands: the faults of each band, in the order of the bands.
        advise_fix: True to recommend that faults are found and replaced.
    """
    messages = []
    for number, band in enumerate(bands, 1):
        where = f"band {number}: " if len(bands) > 1 else ""
        words = [
            *_of_lines("column", band.columns, advise_fix),
            *_of_lines("row", band.rows, advise_fix),
        ]
        for pattern in band.patterns:
            if not pattern.significant:
                continue
            shape = "a checkerboard" if pattern.name == "checkerboard" else pattern.name
            size = f"{pattern.difference:.2%} rms of the level, {pattern.largest:.2%} at most"
            advice = f"; {SHARPENS}: {EQUALIZE}, channel by channel"
            if pattern.largest > COLOUR:
                advice = (
                    ", as of a mosaic of colour filters: split the image into its colours first"
                )
            words.append(f"a fixed pattern of two pixels, {shape}: {size}{advice}")
        if len(band.pixels):
            places = [f"column {column}, row {row}" for row, column in band.pixels.tolist()]
            words.append(
                f"{counted(len(places), 'pixel')} of {band.checked_px}, isolated as no light can "
                f"be: hot, dead or hit by a particle ({_some(places)}); restoration sharpens that"
                f"{FIX + 'pixels' if advise_fix else ''}"
            )
        messages += [f"look at the detectors: {where}{text}" for text in words]
    return messages


def _of_lines(one: str, lines: Stripes, advise_fix: bool) -> Iterator[str]:
    if lines.dead:
        places = [f"{one} {line}" for line in lines.dead]
        yield (
            f"{counted(len(places), f'dead {one}')}, constant where the others vary "
            f"({_some(places)}); restoration sharpens that{f'{FIX}{one}s' if advise_fix else ''}"
        )
    places = [f"{one} {line.index} by {line.gain:+.2%}" for line in lines.off]
    if lines.significant and lines.spread is not None:
        yield (
            f"the gains or offsets of {one}s differ by {lines.spread:.2%} rms of the level; "
            f"{SHARPENS}: {EQUALIZE}, {TRAIN}"
        )
    elif places:
        verb = "is" if len(places) == 1 else "are"
        yield (
            f"{counted(len(places), one)} {verb} off in gain or offset ({_some(places)}); "
            f"{SHARPENS}: {EQUALIZE}, or list them for `fix_detectors`"
        )


def _some(places: Sequence[str]) -> str:
    """Return the first places as text, with a note if there are more of them."""
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return f"{', '.join(places[:NAMED])}{more}"


def figures(bands: Sequence[BandFaults]) -> Mapping[str, Figure]:
    """Return the figures of the faults of detectors by name, for a row of results.

    Args:
        bands: the faults of each band. Of several bands, each name begins with the band's number.
    """
    result = dict[str, Figure]()
    for number, band in enumerate(bands, 1):
        where = f"band {number}: " if len(bands) > 1 else ""
        how = f"{band.checked_px} pixels in strips of the image"
        rms = f"rms over the level, without noise, {how}"
        off = len(band.columns.off) + len(band.rows.off)
        dead = len(band.columns.dead) + len(band.rows.dead)
        result |= {
            f"{where}columns differ by": _spread(band.columns, rms),
            f"{where}rows differ by": _spread(band.rows, rms),
            f"{where}2 x 2 pattern": _pattern(band, rms),
            f"{where}lines off": measured(off, "1", f"single columns and rows, {how}"),
            f"{where}dead lines": measured(dead, "1", f"columns and rows, {how}"),
            f"{where}wrong pixels": measured(len(band.pixels), "1", f"single ones, {how}"),
        }
    return result


def _pattern(band: BandFaults, how: str) -> Figure:
    if not band.patterns:
        return unavailable("%", "too few pixels")
    strongest = max(pattern.difference for pattern in band.patterns)
    return measured(100 * strongest, "%", f"the strongest of three, {how}")


def _spread(lines: Stripes, how: str) -> Figure:
    if lines.spread is None:
        return unavailable("%", "too few lines or blocks along them")
    low, high = lines.spread_interval
    return measured(100 * lines.spread, "%", how, (100 * low, 100 * high))
