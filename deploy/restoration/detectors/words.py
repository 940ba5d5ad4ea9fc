"""The sentences and figures in which `restore` reports faults of detectors."""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence

from beers_deploy.model.metrics.detector_phases import COLOUR, Pattern
from beers_deploy.model.metrics.detector_stripes import Stripes
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.restoration.detectors.fault_list import FOUND, counted
from beers_deploy.restoration.detectors.look import BandFaults, look_at_detectors

logger = logging.getLogger(__name__)

SHARPENS = "restoration about doubles it"
EQUALIZE = "equalize the image first"
FIX = f"`fix_detectors` {FOUND} replaces"
EFFECTS = {"columns": "or train with the effects prnu and dsnu in the sensor's profile", "rows": ""}
"""By kind of line, the effects that describe the faults."""
ERRORS = 2.0
"""The number of standard errors in an interval of 95 %."""
NAMED = 3
"""The largest number of places that a sentence names."""


def warn_of_detectors(source: Source, full_scale: float) -> Mapping[str, Figure]:
    """Detect faults of detectors, log a warning for each kind, and return the figures.

    Args:
        source: the image.
        full_scale: the pixel value at and above which a pixel is not a measurement.
    """
    bands = look_at_detectors(source, full_scale)
    for sentence in sentences(bands):
        logger.warning(sentence)
    return figures(bands)


def sentences(bands: Sequence[BandFaults]) -> list[str]:
    """Return a sentence for each kind of fault in each band."""
    messages = []
    for number, band in enumerate(bands, 1):
        where = f"band {number}: " if len(bands) > 1 else ""
        messages += [f"look at the detectors: {where}{words}" for words in _of_band(band)]
    return messages


def _of_band(band: BandFaults) -> Iterator[str]:
    for name, lines in (("columns", band.columns), ("rows", band.rows)):
        yield from _of_lines(name, lines)
    for pattern in band.patterns:
        if pattern.significant:
            yield _of_pattern(pattern)
    if len(band.pixels):
        places = [f"column {column}, row {row}" for row, column in band.pixels[:NAMED].tolist()]
        yield (
            f"{counted(len(band.pixels), 'pixel')} of {band.looked_px}, isolated as no light can "
            "be: hot, dead or "
            f"hit by a particle ({_some(places, len(band.pixels))}); restoration sharpens that; "
            f"{FIX} such pixels"
        )


def _of_lines(name: str, lines: Stripes) -> Iterator[str]:
    one = name.removesuffix("s")
    if lines.dead:
        places = [str(line) for line in lines.dead[:NAMED]]
        yield (
            f"{counted(len(lines.dead), f'dead {one}')}, constant where the others vary "
            f"({one} {_some(places, len(lines.dead))}); restoration sharpens that; {FIX} such "
            f"{name}"
        )
    kinds = {True: "gains", False: "offsets", None: "gains or offsets"}[lines.grows_with_level]
    remedy = ", ".join(filter(None, (EQUALIZE, EFFECTS[name])))
    if lines.significant and lines.spread is not None:
        worst = f", {one} {lines.off[0].index} by {lines.off[0].gain:+.2%}" if lines.off else ""
        yield (
            f"the {kinds} of {name} differ by {lines.spread:.2%} rms of the level{worst}; "
            f"{SHARPENS}: {remedy}"
        )
    elif lines.off:
        places = [f"{one} {line.index} by {line.gain:+.2%}" for line in lines.off[:NAMED]]
        verb = "is" if len(lines.off) == 1 else "are"
        yield (
            f"{counted(len(lines.off), one)} {verb} off in gain or offset "
            f"({_some(places, len(lines.off))}); "
            f"{SHARPENS}: {EQUALIZE}, or list them for `fix_detectors`"
        )


def _of_pattern(pattern: Pattern) -> str:
    shape = "a checkerboard" if pattern.name == "checkerboard" else pattern.name
    size = f"{pattern.difference:.2%} rms of the level, {pattern.largest:.2%} at most"
    message = f"a fixed pattern of two pixels, {shape}: {size}"

    if pattern.largest > COLOUR:
        return (
            f"{message}, as of a mosaic of colour filters: split the image into its colours first"
        )
    return f"{message}; {SHARPENS}: {EQUALIZE}, channel by channel"


def _some(places: Sequence[str], count: int) -> str:
    """Return the places as text, with a note if there are more of them."""
    more = f" and {count - len(places)} more" if count > len(places) else ""
    return f"{', '.join(places)}{more}"


def figures(bands: Sequence[BandFaults]) -> Mapping[str, Figure]:
    """Return the figures of each band for a row of results."""
    result = dict[str, Figure]()
    for number, band in enumerate(bands, 1):
        where = f"band {number}: " if len(bands) > 1 else ""
        result |= {f"{where}{name}": figure for name, figure in _figures(band).items()}
    return result


def _figures(band: BandFaults) -> dict[str, Figure]:
    how = f"{band.looked_px} pixels in strips of the image"
    lines = {"columns": band.columns, "rows": band.rows}
    rms = f"rms over the level, without noise, {how}"
    pattern = max((pattern.difference for pattern in band.patterns), default=math.nan)
    return {
        **{f"{name} differ by": _spread(stripes, rms) for name, stripes in lines.items()},
        "2 x 2 pattern": measured(100 * pattern, "%", f"the strongest of three, {rms}"),
        "lines off": measured(
            sum(len(stripes.off) for stripes in lines.values()),
            "1",
            f"single columns and rows, {how}",
        ),
        "dead lines": measured(
            sum(len(stripes.dead) for stripes in lines.values()), "1", f"columns and rows, {how}"
        ),
        "wrong pixels": measured(len(band.pixels), "1", f"single ones, {how}"),
    }


def _spread(lines: Stripes, how: str) -> Figure:
    if lines.spread is None:
        return unavailable("%", "too few lines or blocks along them")
    # A spread is never negative, although its interval may reach below 0.
    low, high = (max(lines.spread + sign * ERRORS * lines.spread_error, 0) for sign in (-1, 1))
    return measured(100 * lines.spread, "%", how, (100 * low, 100 * high))
