"""A tabulated MTF or a point-spread function as a sensor's file states it: read, and refused where none can be so."""

import math
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beers_deploy.profiles.constant import Constant, Status, check_keys, is_number, read_stated
from beers_deploy.profiles.errors import ProfileError
from beers_deploy.profiles.response import NYQUIST, MtfTable, PointSpread, Response, centroid, packed
from beers_deploy.profiles.toml import unreadable

READING = 0.005
"""How far a table may lie above what the square detector leaves: half the last digit of two. The detector counts."""
MOST_FREQUENCIES, LEAST_STEP = 1000, 1e-4
SAMPLES_PER_PX = (2.0, 64.0)
"""With fewer than two, nothing is said of the frequencies that sampling by the sensor folds back."""
FILE_SIDE, KEPT_SIDE = 4096, 1024
"""Samples a side: of a file, and of what is kept of it, which a recipe holds as text."""
CUT_SHARE = 1e-6
"""Of the absolute weight: rows and columns at the rim that hold less are cut. No frequency changes by more than twice
as much."""
OFF_CENTRE_PX = 1.0

Samples = NDArray[np.float64]


def read_response(label: str, raw: Mapping[str, Any], folder: Path) -> tuple[Response, Status, str]:
    """What `[mtf]` states by a table or a point-spread function, and that statement's status and source.

    Args:
        label: names the file in errors.
        raw: the table, its keys already checked.
        folder: where the file lies, from which the path of a point-spread function counts.
    """
    key = "psf" if "psf" in raw else "across"
    _, status, source = read_stated(f"{label} {key}", raw[key])
    stated = {name: read_stated(f"{label} {name}", value)[0] for name, value in raw.items()}
    response: Response = _point_spread(label, stated, folder) if key == "psf" else _table(label, stated)
    _require_contrast(f"{label} {key}", response)
    return response, status, source


def axes_of(response: Response, status: Status, source: str) -> dict[str, Any]:
    """The contrasts at Nyquist as a profile's constants; none along the track where it is that across."""
    across, along = (Constant(value, status, source) for value in response.at_nyquist)
    return {"mtf_nyquist": across, "mtf_nyquist_along": along if along != across else None}


def response_from_json(label: str, raw: object) -> Response:
    """A response from the plain values of its fields, as `dataclasses.asdict` and JSON leave them."""
    if not isinstance(raw, Mapping):
        raise ProfileError(label, expected="a table or a point-spread function", got=repr(raw), remedy="make it anew")
    if "samples" not in raw:
        check_keys(label, raw, required={"frequency", "across", "along"})
        response: Response = _table(label, raw)
    else:
        check_keys(label, raw, required={"height", "width", "samples_per_px", "samples"})
        per_px = _samples_per_px(f"{label} samples_per_px", raw["samples_per_px"])
        response = PointSpread(raw["height"], raw["width"], per_px, raw["samples"])
    _require_contrast(label, response)
    return response


def _require_contrast(where: str, response: Response) -> None:
    """Refuse a blur that leaves more contrast at Nyquist than a square detector can, or none."""
    limit = float(np.sinc(NYQUIST))
    for axis, contrast in zip(("across", "along"), response.at_nyquist, strict=True):
        if not 0 < contrast <= limit:
            raise ProfileError(
                where,
                expected=f"a contrast at Nyquist above 0 and up to {limit:.4f} (2/pi, the square detector alone)",
                got=f"{contrast:.4g} {axis} the track",
                remedy="describe the whole system, its detector included, in target pixels",
            )


def _table(label: str, stated: Mapping[str, Any]) -> MtfTable:
    frequency = _numbers(f"{label} frequency", stated["frequency"])
    rising = all(after - before >= LEAST_STEP for before, after in pairwise(frequency))
    if not rising or frequency[0] != 0 or not NYQUIST <= frequency[-1] < 1:
        raise ProfileError(
            f"{label} frequency",
            expected="cycles per pixel, ascending from 0 to 0.5 at least and below 1, the detector's first zero",
            got=f"{len(frequency)} from {frequency[0]:g} to {frequency[-1]:g}"
            + ("" if rising else ", not ascending"),
            remedy=f"give them in that order, in cycles per target pixel, {LEAST_STEP:g} apart at least",
        )
    across = _contrasts(f"{label} across", stated["across"], frequency)
    given = stated.get("along")
    return MtfTable(frequency, across, across if given is None else _contrasts(f"{label} along", given, frequency))


def _contrasts(where: str, raw: object, frequency: tuple[float, ...]) -> tuple[float, ...]:
    contrast = _numbers(where, raw)
    if len(contrast) != len(frequency) or contrast[0] != 1:
        expected = f"{len(frequency)} contrasts, one for each frequency, the first of them 1"
        got = f"{len(contrast)}, the first of them {contrast[0]:g}"
        raise ProfileError(where, expected=expected, got=got, remedy="divide the table by its value at frequency 0")
    for f, value in zip(frequency, contrast, strict=True):
        detector = float(np.sinc(f))
        if not 0 < value <= detector + READING:
            raise ProfileError(
                where,
                expected=f"a contrast above 0 and up to {detector:.4f} at {f:g} cycles per pixel (sinc, the square "
                "detector alone)",
                got=f"{value:g}",
                remedy="describe the whole system; zeros and reversed contrast need a point-spread function, psf",
            )
    return contrast


def _numbers(where: str, raw: object) -> tuple[float, ...]:
    numbers = raw if isinstance(raw, list | tuple) else []
    if not 2 <= len(numbers) <= MOST_FREQUENCIES or not all(map(is_number, numbers)):
        expected = f"a list of 2 to {MOST_FREQUENCIES} finite numbers"
        raise ProfileError(where, expected=expected, got=repr(raw), remedy="give one for each frequency")
    return tuple(map(float, numbers))


def _point_spread(label: str, stated: Mapping[str, Any], folder: Path) -> PointSpread:
    per_px = _samples_per_px(f"{label} psf_samples_per_px", stated["psf_samples_per_px"])
    name = stated["psf"]
    if not isinstance(name, str) or not _lies_within(folder, name):
        expected = "the name of a file beside this one or in a folder beneath"
        raise ProfileError(f"{label} psf", expected=expected, got=repr(name), remedy="copy it there")
    where = f"{label} psf, {folder / name}"
    return _from_samples(where, _read_samples(where, folder / name), per_px)


def _lies_within(folder: Path, name: str) -> bool:
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError):  # a circle of links, a NUL
        return False


def _samples_per_px(where: str, raw: Any) -> float:
    low, high = SAMPLES_PER_PX
    if not is_number(raw) or not low <= raw <= high:
        expected = f"samples that make one target pixel, {low:g} to {high:g}"
        raise ProfileError(where, expected=expected, got=repr(raw), remedy="resample the point-spread function")
    return float(raw)


def _from_samples(where: str, samples: Samples, per_px: float) -> PointSpread:
    """Refuse samples that are no point-spread function; of others, keep what holds nearly all of the weight."""
    finite = bool(np.isfinite(samples).all())
    samples = samples / max(float(np.abs(samples).max()), 1e-300) if finite else samples
    total = float(samples.sum())
    if not finite or total <= 0:
        got = f"a sum of {total:g}" if finite else "NaN or infinite ones"
        remedy = "correct the file; a background must be taken off first"
        raise ProfileError(where, expected="finite samples whose sum is above 0", got=got, remedy=remedy)
    shift_px = math.hypot(*centroid(samples)) / per_px
    if shift_px > OFF_CENTRE_PX:
        expected = f"a centroid within {OFF_CENTRE_PX:g} target pixel of the middle"
        remedy = "crop it around its centroid, and take its background off"
        raise ProfileError(where, expected=expected, got=f"one {shift_px:.3g} pixels off", remedy=remedy)
    kept = _trimmed(samples / total)
    if max(kept.shape) > KEPT_SIDE:
        expected = f"all but a millionth of the weight within {KEPT_SIDE} x {KEPT_SIDE} samples"
        remedy = "crop it, or sample it more coarsely"
        raise ProfileError(where, expected=expected, got=f"{kept.shape[1]} x {kept.shape[0]}", remedy=remedy)
    return PointSpread(len(kept), kept.shape[1], per_px, packed(kept))


def _trimmed(samples: Samples) -> Samples:
    """Without the rows and columns at the rim that hold, all together, less than CUT_SHARE of the weight."""
    weight = np.abs(samples)
    parts = []
    for axis in (1, 0):
        grown = np.cumsum(weight.sum(axis)) / weight.sum()
        parts.append(slice(*np.searchsorted(grown, (CUT_SHARE / 4, 1 - CUT_SHARE / 4)) + np.array([0, 1])))
    return samples[tuple(parts)]


def _read_samples(where: str, path: Path) -> Samples:
    """The samples of a .npy file, (H, W)."""
    reason = unreadable(path) if path.suffix.lower() == ".npy" else f"one that ends in {path.suffix!r}"
    if reason:
        remedy = "check the path, which counts from the profile's folder"
        raise ProfileError(where, expected="a .npy file", got=reason, remedy=remedy)
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)  # nothing is read before its shape is known
        if (
            found.ndim != 2
            or found.dtype.kind not in "iuf"
            or not 1 <= min(found.shape) <= max(found.shape) <= FILE_SIDE
        ):
            raise ValueError(f"{found.dtype} of shape {found.shape}")
        return np.asarray(found, np.float64)
    except Exception as error:  # whatever the bytes of a damaged file lead to
        expected = f"one array of real numbers, (rows, columns), of at most {FILE_SIDE} a side"
        got, remedy = str(error) or type(error).__name__, "crop it, leave one plane, and save it by numpy.save"
        raise ProfileError(where, expected=expected, got=got, remedy=remedy) from error
