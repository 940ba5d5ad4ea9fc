"""The blur of a whole instrument, detector included, where more is known of it than its contrast at
Nyquist.

Either a tabulated MTF or a point-spread function, read as a sensor's file states it, and refused
where none can be. Both are plain values: they compare, hash and travel in JSON. Frequencies are in
cycles per target pixel; "across" the track is horizontal (fx, along a row), "along" it vertical.
"""

import base64
import hashlib
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beers_deploy.profiles.constant import Constant, Status, check_keys, is_number, read_stated
from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.toml import unreadable

NYQUIST = 0.5
"""Cycles per pixel."""
Frequencies = NDArray[np.floating]


@dataclass(frozen=True)
class MtfTable:
    """Contrast at some frequencies, measured on each axis.

    Attributes:
        frequency: ascending from 0, to 0.5 at least and below 1, in cycles per target pixel.
        across: contrast across the track at each, 1 at frequency 0, above 0 everywhere.
        along: likewise along the track.
    """

    frequency: tuple[float, ...]
    across: tuple[float, ...]
    along: tuple[float, ...]

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel, across and along the track."""
        return _contrast_at_nyquist(self)

    def at(self, fx: Frequencies, fy: Frequencies) -> NDArray[np.float64]:
        """The MTF at fx (1, W) and fy (H, 1): (H, W).

        What the square detector leaves is divided out; -log of the rest is interpolated linearly
        over the radius r, which gives each axis its gamma(r) = -log / r. Then as the formula's two
        axes: exp(-sqrt((gamma_x fx)^2 + (gamma_y fy)^2)) sinc(fx) sinc(fy). A table of the formula
        gives the formula. Beyond the last frequency gamma stays what it was there: contrast falls
        on.
        """
        radius = np.hypot(fx, fy)
        gamma_x, gamma_y = (self._gamma(radius, contrast) for contrast in (self.across, self.along))
        optics = np.exp(-np.hypot(gamma_x * fx, gamma_y * fy))
        return np.asarray(optics * np.sinc(fx) * np.sinc(fy))

    def _gamma(self, radius: Frequencies, contrast: tuple[float, ...]) -> Frequencies:
        frequency = np.array(self.frequency)
        # Rounded tables exceed the detector's own contrast by a little at low frequencies.
        loss = np.maximum(-np.log(np.array(contrast) / np.sinc(frequency)), 0.0)
        # Towards 0, where there is nothing to divide by, and beyond the end gamma stays what it
        # was.
        inside = np.clip(radius, frequency[1], frequency[-1])
        return np.asarray(np.interp(inside, frequency, loss) / inside)

    def __str__(self) -> str:
        return (
            f"MTF table of {len(self.frequency)} frequencies up to {self.frequency[-1]:g} "
            "cycles per pixel"
        )


@dataclass(frozen=True)
class PointSpread:
    """The image of a point, (height, width) samples, down the track and across it.

    Attributes:
        height: rows of samples.
        width: columns of samples.
        samples_per_px: how many of them, in each direction, make one target pixel; 2 or more.
        samples: their values as text (`packed`), which a set, a cache and JSON take as it is.
    """

    height: int
    width: int
    samples_per_px: float
    samples: str

    @property
    def at_nyquist(self) -> tuple[float, float]:
        """Contrast at 0.5 cycles per pixel, across and along the track, whatever its sign."""
        return _contrast_at_nyquist(self)

    def at(self, fx: Frequencies, fy: Frequencies) -> NDArray[np.complex128]:
        """Its Fourier transform at fx (1, W) and fy (H, 1), complex (H, W): the sum itself, exact
        to rounding.

        Samples are taken at points; their sum counts as 1 and their centroid lies at 0, so that the
        blur keeps radiance and shifts nothing. Beyond half its sampling frequency a sampled
        function says nothing: 0 there.
        """
        values, y_px, x_px = _grid(self)
        waves_y, waves_x = (
            np.exp(-2j * np.pi * np.outer(place, f)) * (np.abs(f) <= self.samples_per_px / 2)
            for place, f in ((y_px, np.ravel(fy)), (x_px, np.ravel(fx)))
        )
        return np.asarray(waves_y.T @ (values @ waves_x))

    def __str__(self) -> str:
        digest = hashlib.sha256(self.samples.encode()).hexdigest()[:12]
        return (
            f"point-spread function of {self.width} x {self.height} samples, "
            f"{self.samples_per_px:g} to a pixel "
            f"({digest})"
        )


Response = MtfTable | PointSpread


def packed(values: NDArray[np.floating]) -> str:
    """Samples of any shape as text: float32, compressed, in base 64."""
    content = np.ascontiguousarray(values, "<f4").tobytes()
    return base64.b64encode(zlib.compress(content, 9)).decode()


def unpacked(point: PointSpread) -> NDArray[np.float64]:
    """The samples, (height, width)."""
    count_bytes = 4 * point.height * point.width
    try:
        compressed = base64.b64decode(point.samples, validate=True)
        # The limit stops a text that would unpack to more than the samples.
        content = zlib.decompressobj().decompress(compressed, count_bytes)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    return np.frombuffer(content, "<f4").astype(np.float64).reshape(point.height, point.width)


def centroid(values: NDArray[np.float64]) -> tuple[float, float]:
    """Row and column of the centre of gravity of samples (H, W) whose sum is not 0, counted from
    the middle.
    """
    rows, columns = ((np.arange(size) - (size - 1) / 2) for size in values.shape)
    total = values.sum()
    return float(values.sum(1) @ rows / total), float(values.sum(0) @ columns / total)


@lru_cache(maxsize=8)
def _grid(point: PointSpread) -> tuple[NDArray[np.float64], ...]:
    """Samples of sum 1, and where their rows and columns lie from the centroid,
    in target pixels.
    """
    values = unpacked(point)
    places = (
        (np.arange(size) - (size - 1) / 2 - middle) / point.samples_per_px
        for size, middle in zip(values.shape, centroid(values), strict=True)
    )
    return values / values.sum(), *places


@lru_cache(maxsize=64)
def _contrast_at_nyquist(response: Response) -> tuple[float, float]:
    none = np.zeros((1, 1))
    nyquist = np.full((1, 1), NYQUIST)
    across, along = (
        float(np.abs(response.at(*f)[0, 0])) for f in ((nyquist, none), (none, nyquist))
    )
    return across, along


READING = 0.005
"""How far a table may lie above what the square detector leaves: half the last digit of two.

The detector counts.
"""
MOST_FREQUENCIES = 1000
LEAST_STEP = 1e-4
SAMPLES_PER_PX = (2.0, 64.0)
"""With fewer than two, nothing is said of the frequencies that sampling by the
sensor folds back.
"""
FILE_SIDE = 4096
KEPT_SIDE = 1024
"""Samples a side: of a file, and of what is kept of it, which a recipe holds as text."""
CUT_SHARE = 1e-6
"""Of the absolute weight: rows and columns at the rim that hold less are cut.

No frequency changes by more than twice as much.
"""
OFF_CENTRE_PX = 1.0


def read_response(label: str, raw: Mapping[str, Any], folder: Path) -> tuple[Response, Status, str]:
    """What `[mtf]` states by a table or a point-spread function, and that statement's status and
    source.

    Args:
        label: names the file in errors.
        raw: the table, its keys already checked.
        folder: where the file lies, from which the path of a point-spread function counts.
    """
    key = "psf" if "psf" in raw else "across"
    _, status, source = read_stated(f"{label} {key}", raw[key])
    values = {name: read_stated(f"{label} {name}", value)[0] for name, value in raw.items()}
    response: Response = (
        _point_spread(label, values, folder) if key == "psf" else _table(label, values)
    )
    _require_contrast(f"{label} {key}", response)
    return response, status, source


def axes_of(response: Response, status: Status, source: str) -> dict[str, Any]:
    """The contrasts at Nyquist as a profile's constants; none along the track where it is that
    across.
    """
    across, along = (Constant(value, status, source) for value in response.at_nyquist)
    return {"mtf_nyquist": across, "mtf_nyquist_along": along if along != across else None}


def response_from_json(label: str, raw: object) -> Response:
    """A response from the plain values of its fields, as `dataclasses.asdict`
    and JSON leave them.
    """
    if not isinstance(raw, Mapping):
        raise ProfileError(
            f"{label} must be a table or a point-spread function, got {printable(repr(raw))}. "
            "Generate the file again."
        )
    if "samples" not in raw:
        check_keys(label, raw, required={"frequency", "across", "along"})
        response: Response = _table(label, raw)
    else:
        check_keys(label, raw, required={"height", "width", "samples_per_px", "samples"})
        response = _stored_point_spread(label, raw)
    _require_contrast(label, response)
    return response


def _stored_point_spread(label: str, raw: Mapping[str, Any]) -> PointSpread:
    """Read a point-spread function that `packed` stored."""
    per_px = _samples_per_px(f"{label} samples_per_px", raw["samples_per_px"])
    point = PointSpread(raw["height"], raw["width"], per_px, raw["samples"])
    try:
        # Before unpacking: a size of 0 bytes would unpack as much as the text holds.
        if not all(
            type(side) is int and 1 <= side <= KEPT_SIDE for side in (point.height, point.width)
        ):
            raise ValueError(f"it states {point.height!r} x {point.width!r} samples")
        samples = unpacked(point)
        if not (np.isfinite(samples).all() and samples.sum() > 0):
            raise ValueError("they are not finite, or their sum is not above 0")
    except (TypeError, ValueError) as error:
        raise ProfileError(
            f"{label} does not hold the samples of a point-spread function as they were stored: "
            f"{printable(str(error))}. Generate the file again."
        ) from error
    return point


def _require_contrast(where: str, response: Response) -> None:
    """Refuse a blur that leaves more contrast at Nyquist than a square detector can, or none."""
    limit = float(np.sinc(NYQUIST))
    for axis, contrast in zip(("across", "along"), response.at_nyquist, strict=True):
        if not 0 < contrast <= limit:
            raise ProfileError(
                f"{where} has a contrast of {contrast:.4g} at Nyquist {axis} the track, but it "
                f"must be above 0 and at most {limit:.4f} (2/pi, the square detector alone). "
                "Describe the whole system, its detector included, in target pixels."
            )


def _table(label: str, values: Mapping[str, Any]) -> MtfTable:
    frequency = _numbers(f"{label} frequency", values["frequency"])
    rising = all(after - before >= LEAST_STEP for before, after in pairwise(frequency))
    if not rising or frequency[0] != 0 or not NYQUIST <= frequency[-1] < 1:
        order = "" if rising else " that are not ascending"
        raise ProfileError(
            f"{label} frequency must be ascending from 0 to at least 0.5 and below 1 cycles per "
            f"pixel (the detector's first zero), but it has {len(frequency)} values from "
            f"{frequency[0]:g} to {frequency[-1]:g}{order}. Give them in that order, in cycles per "
            f"target pixel, at least {LEAST_STEP:g} apart."
        )
    across = _contrasts(f"{label} across", values["across"], frequency)
    along = values.get("along")
    return MtfTable(
        frequency,
        across,
        across if along is None else _contrasts(f"{label} along", along, frequency),
    )


def _contrasts(where: str, raw: object, frequency: tuple[float, ...]) -> tuple[float, ...]:
    contrast = _numbers(where, raw)
    if len(contrast) != len(frequency) or contrast[0] != 1:
        raise ProfileError(
            f"{where} must have {len(frequency)} contrasts, one for each frequency and the first "
            f"of them 1, but it has {len(contrast)}, the first of them {contrast[0]:g}. Divide the "
            "table by its value at frequency 0."
        )
    for f, value in zip(frequency, contrast, strict=True):
        detector = float(np.sinc(f))
        if not 0 < value <= detector + READING:
            raise ProfileError(
                f"{where} has a contrast of {value:g} at {f:g} cycles per pixel, but it must be "
                f"above 0 and at most {detector:.4f} there (sinc, the square detector alone). "
                "Describe the whole system; zeros and reversed contrast need a point-spread "
                "function, psf."
            )
    return contrast


def _numbers(where: str, raw: object) -> tuple[float, ...]:
    numbers = raw if isinstance(raw, list | tuple) else []
    if not 2 <= len(numbers) <= MOST_FREQUENCIES or not all(map(is_number, numbers)):
        raise ProfileError(
            f"{where} must be a list of 2 to {MOST_FREQUENCIES} finite numbers, one for each "
            f"frequency, got {printable(repr(raw))}."
        )
    return tuple(map(float, numbers))


def _point_spread(label: str, values: Mapping[str, Any], folder: Path) -> PointSpread:
    per_px = _samples_per_px(f"{label} psf_samples_per_px", values["psf_samples_per_px"])
    name = values["psf"]
    if not isinstance(name, str) or not _lies_within(folder, name):
        raise ProfileError(
            f"{label} psf must be the name of a file in the profile's folder or below it, got "
            f"{printable(repr(name))}. Copy the file there."
        )
    where = f"{label} psf ({folder / name})"
    return _from_samples(where, _read_samples(where, folder / name), per_px)


def _lies_within(folder: Path, name: str) -> bool:
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    # A circle of links raises the first, a NUL the second.
    except (OSError, ValueError):
        return False


def _samples_per_px(where: str, raw: Any) -> float:
    low, high = SAMPLES_PER_PX
    if not is_number(raw) or not low <= raw <= high:
        raise ProfileError(
            f"{where} must be {low:g} to {high:g} samples per target pixel, got "
            f"{printable(repr(raw))}. Resample the point-spread function."
        )
    return float(raw)


def _from_samples(where: str, samples: NDArray[np.float64], per_px: float) -> PointSpread:
    """Refuse samples that are no point-spread function; of others, keep what holds nearly all of
    the weight.
    """
    finite = bool(np.isfinite(samples).all())
    # The largest is brought to 1 first, because the sum of finite samples may overflow.
    samples = samples / max(float(np.abs(samples).max()), 1e-300) if finite else samples
    total = float(samples.sum())
    if not finite or total <= 0:
        fault = f"their sum is {total:g}" if finite else "some are NaN or infinite"
        raise ProfileError(
            f"{where} must hold finite samples whose sum is above 0, but {fault}. Correct the "
            "file; a background must be subtracted first."
        )
    shift_px = math.hypot(*centroid(samples)) / per_px
    if shift_px > OFF_CENTRE_PX:
        raise ProfileError(
            f"{where} must have its centroid within {OFF_CENTRE_PX:g} target pixel of the middle, "
            f"but it lies {shift_px:.3g} pixels off. Crop the file around its centroid, and "
            "subtract its background."
        )
    core = _trimmed(samples / total)
    if max(core.shape) > KEPT_SIDE:
        raise ProfileError(
            f"{where} must have all but a millionth of its weight within {KEPT_SIDE} x {KEPT_SIDE} "
            f"samples, but it takes {core.shape[1]} x {core.shape[0]}. Crop it, or sample it more "
            "coarsely."
        )
    return PointSpread(len(core), core.shape[1], per_px, packed(core))


def _trimmed(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without the rows and columns at the rim that hold, all together, less than CUT_SHARE of the
    weight.
    """
    weight = np.abs(samples)
    parts = []
    for axis in (1, 0):
        grown = np.cumsum(weight.sum(axis)) / weight.sum()
        # Two axes with two ends each: every end may lose a quarter of the share.
        ends = np.searchsorted(grown, (CUT_SHARE / 4, 1 - CUT_SHARE / 4)) + np.array([0, 1])
        parts.append(slice(*ends))
    return samples[tuple(parts)]


def _read_samples(where: str, path: Path) -> NDArray[np.float64]:
    """The samples of a .npy file, (H, W)."""
    reason = unreadable(path) if path.suffix.lower() == ".npy" else f"it ends in {path.suffix!r}"
    if reason:
        raise ProfileError(
            f"{where} cannot be read as a .npy file: {reason}. Check the path, which is relative "
            "to the profile's folder."
        )
    try:
        # Mapped: nothing is read before its shape is known.
        samples = np.load(path, mmap_mode="r", allow_pickle=False)
        if (
            samples.ndim != 2
            or samples.dtype.kind not in "iuf"
            or not 1 <= min(samples.shape) <= max(samples.shape) <= FILE_SIDE
        ):
            raise ValueError(f"it is {samples.dtype} of shape {samples.shape}")
        return np.asarray(samples, np.float64)
    # The bytes of a damaged file may lead to anything.
    except Exception as error:
        reason = printable(str(error)) or type(error).__name__
        raise ProfileError(
            f"{where} is not one array of real numbers, (rows, columns), of at most {FILE_SIDE} a "
            f"side: {reason}. Crop it, leave one plane, and save it with numpy.save."
        ) from error
