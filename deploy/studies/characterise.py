"""A sensor profile from raw images of the sensor's own: what `characterise` does between options and TOML.

What pixels tell is measured, with intervals: blur by straight edges, noise by the corners of the spectrum. The rest
(gain, ground sampling distance, and bits unless pixels are clipped at full scale) is asked for or assumed.
"""

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from beers_deploy.model.io.tiff import write_tiff
from beers_deploy.model.metrics import edge_blur
from beers_deploy.model.metrics.edge_blur import AxisMtf
from beers_deploy.model.metrics.edge_fit import HALF_PX, POINTED_AT, EdgeBlur, fit_blur
from beers_deploy.model.metrics.noise_line import Blocks, NoiseModel, cut_blocks, fit_noise_model, join
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.progress import Progress, reporting
from beers_deploy.profiles.constant import Status
from beers_deploy.profiles.errors import ImageError, OptionError, printable
from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.profiles.sensor import Sensor, snr_0_bounds
from beers_deploy.profiles.sensor_file import load_sensor, sensor_toml
from beers_deploy.restoration.sensor_check import NOISE_KEPT
from beers_deploy.restoration.source import open_source
from beers_deploy.results import Table, input_of

FULL_SCALE_RADIANCE = 400.0
"""W/m2/sr/um, where no gain is given."""
PARTS = (16, 4)
"""Of full scale: the radiances at which SNRs are stated, as those that a network is told of."""
GSD_M, OVERSAMPLING, SEED = 0.5, 4, 0
AXES = ("across", "along")
TILE_PX, BOX_PX = 1024, 2 * HALF_PX + 1
MAX_DN = 65535
CLIPPED_PIXELS, PILE = 10, 4
"""Pixels at one value, 2^n - 1, and how many times as many as just below: what shows that it is full scale."""
MARGIN = 1e-5
"""Of an SNR, by which it stays off the bounds of physics: decimals are rounded."""


@dataclass(frozen=True)
class Snr:
    """The SNR at one radiance, in W/m2/sr/um, with its 95 % interval (its end may be infinite)."""

    radiance: float
    value: float
    interval: tuple[float, float]
    extrapolated: bool


@dataclass(frozen=True)
class Characterised:
    """What was found.

    Attributes:
        images: that were looked at.
        stated: what the user said of bits, gain in DN per W/m2/sr/um and gsd_m; None of what was not said.
        bits: of a digital number.
        gain: DN per W/m2/sr/um, stated or assumed.
        axes: MTF "across" and "along" the track; an axis that no edge shows is left out.
        snrs: at two radiances.
        noise: the line that they lie on.
    """

    images: Sequence[Path]
    stated: Mapping[str, float | None]
    bits: int
    gain: float
    axes: Mapping[str, AxisMtf]
    snrs: tuple[Snr, Snr]
    noise: NoiseModel

    def rows(self) -> list[Row]:
        """The figures, as commands report them."""
        figures = {f"MTF {name} at Nyquist": _mtf_figure(self.axes.get(name)) for name in AXES}
        for snr in self.snrs:
            source = f"{self.noise.blocks} blocks of 16 x 16" + (", extrapolated" if snr.extrapolated else "")
            figures[f"SNR at {snr.radiance:g} W/m2/sr/um"] = measured(snr.value, "ratio", source, snr.interval)
        return [Row("sensor", "measured sensor", figures)]


def _mtf_figure(axis: AxisMtf | None) -> Figure:
    if axis is None:
        return unavailable("%", "no edge across this axis; the other axis' figure is written for both")
    low, high = axis.interval
    return measured(100 * axis.mtf_nyquist, "%", f"{axis.edges} edges", (100 * low, 100 * high))


def characterise(
    images: Sequence[Path],
    edges: Sequence[str] = (),
    *,
    bits: int | None = None,
    gain: float | None = None,
    gsd_m: float | None = None,
) -> Characterised:
    """Measure a sensor on its own images.

    Args:
        images: raw ones of one sensor at one setting.
        edges: boxes with one straight edge as FILE:X,Y,WIDTH,HEIGHT; none searches for edges.
        bits: of a digital number; None where clipped pixels must tell.
        gain: DN per W/m2/sr/um; None assumes 400 W/m2/sr/um at full scale.
        gsd_m: ground sampling distance; None assumes one.
    """
    for option, value in (("gain", gain), ("gsd", gsd_m)):
        if value is not None and not 0 < value < math.inf:
            raise OptionError(option, expected="a finite number above 0", got=f"{value:g}", remedy="correct it")
    if not images:
        raise ImageError("images", expected="one or several", got="none", remedy="give raw images of one sensor")
    if len({path.resolve() for path in images}) < len(images):
        got, remedy = "one of them twice", "give each once: a second look at the same pixels knows nothing new"
        raise OptionError("images", expected="different images", got=got, remedy=remedy)
    regions = [(words, cut_box(words, images)) for words in edges]
    stated = {"bits": bits, "gain": gain, "gsd_m": gsd_m}
    bits = _settled_bits(bits, images)
    clipped_at = 2**bits - 1
    noise = measured_noise(images, clipped_at)
    axes = _axes(images, regions, noise, clipped_at)
    gain = gain or clipped_at / FULL_SCALE_RADIANCE
    low, high = (snr_at(noise, clipped_at / part, gain) for part in PARTS)
    return Characterised(images, stated, bits, gain, axes, (low, high), noise)


class MeasuredSensor(Sensor):
    """A sensor measured on its own images; `evidence` holds the figures with their intervals."""

    evidence: Table | None = None


def characterize(
    images: Any,
    *,
    bits: int | None = None,
    gain: float | None = None,
    gsd_m: float | None = None,
    edges: Sequence[str] = (),
    progress: Progress = None,
) -> MeasuredSensor:
    """Measure MTF and noise of a sensor on its own raw images.

    Args:
        images: one or several, each a path or an array (H, W) of whole digital numbers, of one sensor at one setting.
        bits: of a digital number; None where clipped pixels must tell.
        gain: DN per W/m2/sr/um; None assumes 400 W/m2/sr/um at full scale.
        gsd_m: ground sampling distance; None assumes one.
        edges: boxes with one straight edge as FILE:X,Y,WIDTH,HEIGHT; none searches for edges.
        progress: a function that is told each step, False for silence, None for a bar or lines on standard error.

    Raises:
        ImageError: images that are not raw, or that do not hold what is needed; the message says what that is.
        OptionError: an option that contradicts the pixels.

    Examples:
        >>> raw = bd.simulate(size=256, seed=1).degraded
        >>> found = bd.characterize(raw, bits=12, gain=10.2375)
        >>> 0.05 < found.mtf_nyquist.low < 0.09  # the truth is 0.07
        True
    """
    several = images if isinstance(images, list | tuple) else [images]
    with TemporaryDirectory(prefix="beers-deploy-") as folder, reporting(progress):
        paths = [_as_file(image, Path(folder) / f"image{number}.tif") for number, image in enumerate(several)]
        found = characterise(paths, edges, bits=bits, gain=gain, gsd_m=gsd_m)
        profile = Path(folder) / "measured.toml"
        profile.write_text(profile_toml(found), encoding="utf-8")
        sensor = MeasuredSensor(**vars(load_sensor(str(profile))))
        arguments = {"bits": bits, "gain": gain, "gsd": gsd_m, "edge": ", ".join(edges) or None}
        evidence = Table("characterise", arguments, tuple(map(input_of, paths)), tuple(found.rows()))
    object.__setattr__(sensor, "evidence", evidence)
    return sensor


def _as_file(image: Any, path: Path) -> Path:
    if isinstance(image, str | os.PathLike):
        return Path(image)
    pixels = np.asarray(getattr(image, "values", image))
    if pixels.ndim == 3 and len(pixels) == 1:
        pixels = pixels[0]
    if pixels.ndim != 2 or pixels.dtype.kind not in "ui":
        got, remedy = f"{pixels.dtype} of shape {pixels.shape}", "give raw pixels of one band"
        raise ImageError("images", expected="whole digital numbers (H, W)", got=got, remedy=remedy)
    write_tiff(path, pixels.astype(np.uint16))
    return path


def read_raw(path: Path) -> np.ndarray:
    """Digital numbers (H, W) of one band, integers of any width; 0 where they are missing."""
    with open_source(path) as source:
        raster, rows = source.raster, source.read(0, source.raster.height_px)
    if raster.bands != 1:
        got, remedy = f"{raster.bands} bands", "extract one band; each has a sensor of its own"
        raise ImageError(str(path), expected="one band", got=got, remedy=remedy)
    held = np.ma.getdata(rows)[0]
    pixels = np.where(raster.missing(rows)[0], 0, held) if raster.may_miss else held
    if (pixels.dtype.kind == "f" and (pixels != np.rint(pixels)).any()) or pixels.min() < 0 or pixels.max() > MAX_DN:
        got = f"{pixels.dtype} from {float(pixels.min()):.4g} to {float(pixels.max()):.4g}"
        remedy = "give the raw image: what was resampled, calibrated or scaled has lost its noise"
        raise ImageError(str(path), expected=f"whole digital numbers from 0 to {MAX_DN}", got=got, remedy=remedy)
    return pixels


def _tiles(images: Sequence[Path]) -> Iterator[np.ndarray]:
    for pixels in map(read_raw, images):
        for top in range(0, pixels.shape[0], TILE_PX):
            for left in range(0, pixels.shape[1], TILE_PX):
                yield pixels[top : top + TILE_PX, left : left + TILE_PX].astype(np.float64)


def _settled_bits(stated: int | None, images: Sequence[Path]) -> int:
    """The bits that were given, or those that pixels clipped at full scale show."""
    largest, full_scale = max(_brightest(path) for path in images)
    bits = largest.bit_length() if stated is None else stated
    if stated is None and not full_scale:
        expected = "`bits` beside images that are not clipped at full scale, or are stored in 8 bits"
        remedy = "give the digitiser's, such as 12"
        raise OptionError("bits", expected=expected, got=f"values up to {largest}", remedy=remedy)
    if largest > 2**bits - 1:
        expected, remedy = f"digital numbers up to {2**bits - 1}", "give the bits of the raw image"
        raise OptionError("bits", expected=expected, got=f"{largest}", remedy=remedy)
    return bits


def _brightest(path: Path) -> tuple[int, bool]:
    """The largest digital number of an image, and whether pixels pile up there as at a full scale alone."""
    pixels = read_raw(path)
    largest, whole = int(pixels.max()), pixels.astype(np.int64, copy=False).ravel()
    step = int(np.gcd.reduce(whole - whole.min()))
    if step > 1:
        remedy = f"divide it by {step}: {step - 1} of {step} values never occur, so they are no digital numbers"
        raise ImageError(str(path), expected="digital numbers in steps of 1", got=f"steps of {step}", remedy=remedy)
    count, below = (int((whole == value).sum()) for value in (largest, largest - 1))
    piled = count >= max(CLIPPED_PIXELS, PILE * below) and pixels.dtype.itemsize > 1
    return largest, piled and largest == 2 ** largest.bit_length() - 1


def snr_at(noise: NoiseModel, dn: float, gain: float) -> Snr:
    """The SNR at a digital number, the rounding not in it."""
    variance = noise.at(dn)
    low, value, high = (
        dn / math.sqrt(v) if v > 0 else math.inf for v in (variance.interval[1], variance.value, variance.interval[0])
    )
    return Snr(dn / gain, value, (low, high), variance.extrapolated)


def measured_noise(images: Sequence[Path], clipped_at: int) -> NoiseModel:
    """The noise in the digital numbers of images that clip at a value."""
    each = [join([cut_blocks(tile, clipped_at) for tile in _tiles([image])]) for image in images]
    noise = fit_noise_model(join(each), np.random.default_rng(SEED))
    if isinstance(noise, Refusal):
        expected = "blurred, raw ground with white noise, from dark to bright"
        remedy = "give more raw images of plain ground, dark and bright, neither restored nor resampled"
        raise ImageError(f"noise of {_named(images)}", expected=expected, got=noise.reason, remedy=remedy)
    _require_one_sensor(images, each, math.sqrt(math.prod(noise.measured_dn)))
    return noise


def _require_one_sensor(images: Sequence[Path], each: Sequence[Blocks], dn: float) -> None:
    """Refuse images whose own noise at a digital number differs: of another gain, or processed."""
    lines = [fit_noise_model(blocks, np.random.default_rng(SEED)) for blocks in each] if len(images) > 1 else []
    seen = {path.name: line.at(dn) for path, line in zip(images, lines, strict=False) if isinstance(line, NoiseModel)}
    if not seen:
        return
    least = min(seen, key=lambda name: seen[name].interval[1])
    most = max(seen, key=lambda name: seen[name].interval[0])
    if seen[most].interval[0] > NOISE_KEPT * seen[least].interval[1]:
        low, high = (f"{seen[name].value:.3g} DN^2 in {name}" for name in (least, most))
        got = f"a variance of {low} and {high} at {dn:.4g} DN"
        remedy = "characterise them apart: they differ in gain, or one was processed"
        raise ImageError("images", expected="images of one sensor at one setting", got=got, remedy=remedy)


def _named(images: Sequence[Path]) -> str:
    more = f" and {len(images) - 1} more" if len(images) > 1 else ""
    return f"{images[0].name}{more}"


def _axes(
    images: Sequence[Path], regions: Sequence[tuple[str, np.ndarray]], noise: NoiseModel, clipped_at: float
) -> dict[str, AxisMtf]:
    """MTF across (edges near the vertical) and along the track, at least one of them."""
    upright, lying = _pointed_at(regions, noise, clipped_at)
    for tile in () if regions else _tiles(images):
        upright += edge_blur.find_blurs(tile, noise.total, clipped_at)
        lying += edge_blur.find_blurs(tile.T, noise.total, clipped_at)
    least, edges = 1 if regions else edge_blur.MIN_FOUND, zip(AXES, (upright, lying), (lying, upright), strict=True)
    axes = {name: edge_blur.combine(own, others) for name, own, others in edges if len(own) >= least}
    if not axes:
        expected = (
            f"{edge_blur.MIN_FOUND} straight edges between even areas, 17 pixels long and 8 to both sides, or more"
        )
        got = f"{len(upright)} near the vertical and {len(lying)} near the horizontal"
        remedy = "point at one as `edge` FILE:X,Y,WIDTH,HEIGHT, or image a target, a large roof or an apron"
        raise ImageError(f"edges of {_named(images)}", expected=expected, got=got, remedy=remedy)
    return axes


def _pointed_at(
    regions: Sequence[tuple[str, np.ndarray]], noise: NoiseModel, clipped_at: float
) -> tuple[list[EdgeBlur], list[EdgeBlur]]:
    """The edges in boxes, by their words: those near the vertical, and those near the horizontal."""
    found: tuple[list[EdgeBlur], list[EdgeBlur]] = ([], [])
    for words, region in regions:
        lies = _rise(region.T) > _rise(region)
        edge = fit_blur(region.T if lies else region, noise.total, POINTED_AT)
        if region.min() <= 0 or region.max() >= clipped_at:
            edge = Refusal("clipped pixels")
        if isinstance(edge, Refusal):
            expected, remedy = "one straight edge, from side to side", "box another, or tighter"
            raise ImageError(f"edge {words}", expected=expected, got=edge.reason, remedy=remedy)
        found[lies].append(edge)
    return found


def cut_box(words: str, images: Sequence[Path]) -> np.ndarray:
    """The pixels (h, w) that FILE:X,Y,WIDTH,HEIGHT names, FILE being one of the images."""
    parts = re.fullmatch(r"(.*):(\d{1,8}),(\d{1,8}),(\d{1,8}),(\d{1,8})", words, re.ASCII)
    if parts is None:
        expected, remedy = "FILE:X,Y,WIDTH,HEIGHT in whole pixels", "write raw.tif:1200,340,60,60"
        raise OptionError("edge", expected=expected, got=repr(words), remedy=remedy)
    name, (left, top, width, height) = Path(parts[1]), map(int, parts.groups()[1:])
    if name not in images:
        remedy = "name it as the argument does"
        raise OptionError("edge", expected="one of the images that are given", got=repr(parts[1]), remedy=remedy)
    pixels = read_raw(name)
    region = pixels[top : top + height, left : left + width].astype(np.float64)
    if region.shape != (height, width) or min(region.shape) < BOX_PX:
        expected = f"a box of {BOX_PX} x {BOX_PX} pixels or more inside its {pixels.shape[1]} x {pixels.shape[0]}"
        raise OptionError("edge", expected=expected, got=words, remedy="X,Y is the upper left pixel, from 0")
    return region


def _rise(region: np.ndarray) -> float:
    """How much brighter one side is than the other, along the rows."""
    first, *_, last = np.array_split(region, 3, axis=1)
    return abs(float(last.mean() - first.mean()))


def profile_toml(found: Characterised) -> str:
    """The profile as its TOML file; the source of what was measured has its interval, and any doubt."""
    images, stated, full_scale = printable(_named(found.images)), found.stated, 2**found.bits - 1
    clipped = "given" if stated["bits"] else f"pixels clipped at {full_scale} in {images}"
    gain = (
        f"full scale {full_scale} DN = {FULL_SCALE_RADIANCE:g} W/m2/sr/um; pixels do not tell the gain, and to a "
        "network only noise over full scale matters"
    )
    tables: dict[str, dict[str, object]] = {
        "grid": {
            "gsd_m": _given(stated["gsd_m"], GSD_M, "no pixel depends on it; state it"),
            "oversampling": _said(OVERSAMPLING, "assumed", "for simulations alone: scene pixels a pixel"),
        },
        "mtf": _mtf_table(found, images),
        "noise": _noise_table(found, images),
        "digitiser": {
            "bits": _said(found.bits, "stated" if stated["bits"] else "measured", clipped),
            "gain_dn_per_radiance": _given(stated["gain"], found.gain, gain),
        },
    }
    return sensor_toml(f"Measured on {images}.", tables)


def _mtf_table(found: Characterised, images: str) -> dict[str, object]:
    """Of an axis that no edge shows there is nothing: it then has the other's."""
    table = dict[str, object]()
    for key, (name, axis) in zip(("mtf_nyquist", "mtf_nyquist_along"), found.axes.items(), strict=False):
        low, high = axis.interval
        edges = f"{axis.edges} edge{'' if axis.edges == 1 else 's'}"
        source = f"{edges} in {images} {name} the track, 95 % interval {low:.3g} to {high:.3g}"
        if len(found.axes) == 1:
            source += "; no edge shows the other axis"
        if not low <= axis.nearest <= high:
            source += f"; the curve is not the profile's, whose nearest one has {axis.nearest:.3g}"
        table[key] = _said(float(f"{axis.mtf_nyquist:.4g}"), "measured", source)
    return table


def _noise_table(found: Characterised, images: str) -> dict[str, object]:
    """The SNRs are linear ratios without the rounding to whole DN; the darker one is kept within physics."""
    dark, bright = (dn / found.gain for dn in found.noise.measured_dn)
    low, high = found.snrs
    bounds = snr_0_bounds(low.radiance, high.radiance, high.value)
    inside = min(max(low.value, bounds[0] * (1 + MARGIN)), bounds[1] * (1 - MARGIN))
    blocks, table = f"{found.noise.blocks} blocks of 16 x 16 in {images}", dict[str, object]()
    for number, (snr, value, part) in enumerate(zip(found.snrs, (inside, high.value), PARTS, strict=True)):
        beyond = f"; extrapolated from {dark:.3g} to {bright:.3g} W/m2/sr/um" if snr.extrapolated else ""
        source = f"{blocks}, 95 % interval {snr.interval[0]:.3g} to {snr.interval[1]:.3g}{beyond}"
        table[f"radiance_{number}"] = _said(float(f"{snr.radiance:.10g}"), "inferred", f"1/{part} of full scale")
        table[f"snr_{number}"] = _said(float(f"{value:.8g}"), "measured", source)
    return table


def _given(given: float | None, otherwise: float, why: str) -> dict[str, object]:
    if given is None:
        return _said(float(f"{otherwise:.10g}"), "assumed", why)
    return _said(given, "stated", "given on the command line")


def _said(value: float, status: Status, source: str) -> dict[str, object]:
    return {"value": value, "status": status, "source": source}
