"""`characterize`: a sensor profile from raw images of the sensor."""

import logging
import math
from typing import TYPE_CHECKING, Annotated, Any

from beers_deploy.profiles.errors import OptionError, listed
from beers_deploy.verbs.parameters import Edges, Images, Interval, Mtf, Progress, RequiredFile
from beers_deploy.verbs.verb import path_or_none, refuse_with, verb

if TYPE_CHECKING:
    from beers_deploy.studies.characterize import MeasuredSensor

logger = logging.getLogger(__name__)


@verb
def characterize(
    images: Images,
    *,
    out: RequiredFile | None = None,
    edge: Edges = (),
    mtf: Mtf | None = None,
    black_level: float | None = None,
    bits: Annotated[int, Interval(ge=1, le=16)] | None = None,
    gain: float | None = None,
    gsd: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> "MeasuredSensor":
    """Measure the MTF and the noise of a sensor on its raw images, and write its profile.

    The MTF needs straight edges (a target, roofs, kerbs, shadows), else `mtf` or an assumption
    takes its place. Images that were denoised, sharpened or resampled are refused, because the
    noise needs raw pixels.

    Args:
        images: raw images of one sensor at one setting, or folders of them: integers, one band. In
            Python also arrays (H, W).
        out: sensor profile to write, a .toml file.
        edge: box with one straight edge, FILE:X,Y,WIDTH,HEIGHT; searched for by default.
        mtf: contrast at Nyquist across the track, or across and along it, if you know it: 0.07 is 7
            %; measured by default.
        black_level: pixel value of the dark; assumed to be 0 by default.
        bits: bits of a pixel; found from clipped pixels by default.
        gain: DN per W/m2/sr/um; by default full scale is assumed to be 400 W/m2/sr/um.
        gsd: ground sampling distance in m; no pixel depends on it.
        overwrite: replace the profile if it exists.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        The sensor. Its `table` has the figures with their intervals.

    Raises:
        ImageError: images that are not raw, or that lack what is needed.
        OptionError: an option that contradicts the pixels, or an `out` that exists or
            is no .toml file.

    Examples:
        >>> raw = bd.simulate(size=256, seed=1).degraded
        >>> sensor = bd.characterize(raw, bits=12, gain=10.2375)
        >>> 0.05 < sensor.mtf_nyquist.low < 0.09  # the truth is 0.07
        True
    """
    from beers_deploy.model.io.files import write_text
    from beers_deploy.studies.characterize import Stated, measured_sensor

    file = path_or_none(out)
    if file is not None and file.suffix != ".toml":
        raise OptionError(f"`out` must end in .toml, as sensor profiles do, got {file}.")
    if file is not None and file.exists() and not overwrite:
        raise OptionError(
            f"{file} exists already. Add `overwrite` to replace it, or choose another name."
        )
    edges = [edge] if isinstance(edge, str) else list(edge)
    refuse_with("`mtf`", edge=mtf is not None and bool(edges))
    stated = Stated(bits, gain, gsd, black_level, None if mtf is None else contrasts(mtf))
    sensor, toml = measured_sensor(images, edges, stated)
    if file is not None:
        write_text(file, toml)
        logger.info("wrote %s: beers-deploy profiles %s", file, file)
    return sensor


def contrasts(mtf: Any) -> tuple[float, float]:
    """Return the contrast at Nyquist across and along the track; one number stands for both."""
    from beers_deploy.profiles.instrument import MTF_NYQUIST_MAX

    # One number is used for both axes.
    try:
        numbers = [float(part) for part in listed(mtf)]
        across, along = numbers * 2 if len(numbers) == 1 else numbers
    except (TypeError, ValueError):
        # NaN lies within no limits, so the message below covers words as well.
        across = along = math.nan
    if not (0 < across <= MTF_NYQUIST_MAX and 0 < along <= MTF_NYQUIST_MAX):
        raise OptionError(
            f"`mtf` must be one or two ratios above 0 and up to {MTF_NYQUIST_MAX:.4f}, got "
            f"{mtf!r}. Write 0.07 for 7 %, or 0.09,0.05."
        )
    return across, along
