#!/usr/bin/env python3
"""Run the host part of a network on a board.

    python3 host.py image.npy restored.npy

Images are float32 (C, H, W) as the network reads them, in [0, 1] unless host.json has other
factors. The script needs NumPy, host.json and onnxruntime; a board needs other runners in `cores`.

1. Each tile goes to core.onnx. Where host.json has exposures, core-x4.onnx restores dark pixels,
   multiplied by 4, and so on (`factors`, `exposed`).
2. Around a core, the host encodes the tile as int8 planes, and adds the result to the tile, or to
   channels of it, also enlarged (`restored`, `base`).
3. After the last tile, the consistency step (`consistent`) smooths the dark and corrects low
   spatial frequencies.
4. Then the self-check (`judged`) writes two figures of each block into restored-check.npy.
5. Each core restores a drawn tile (`known_tile`), to be compared with known.json (`--learn`).
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np

F = np.float32
HERE = Path(__file__).parent
CHECK = 64
CLOSE = 16
BLOCK = 8
FINE = 2
NEAR = 8
"""Pixels: the sides of blocks of the self-check (CHECK), and of the consistency step (BLOCK, FINE);
the radius of its near blur (NEAR), and the distance of the self-check from saturation (CLOSE).
"""
S = json.loads((HERE / "host.json").read_text(encoding="utf-8"))
DARK = F(S["offset"])
UNITS = {1.0: S["unit"], **{float(factor): unit for factor, unit in S["exposures"].items()}}
"""The unit of each core's result, by the factor that the core's tile is multiplied by."""


def shuffled(x: np.ndarray, r: int, up: bool) -> np.ndarray:
    """Move squares of r x r pixels of (1, C, H, W) into the channels, or back if `up`."""
    _, c, h, w = x.shape
    if up:
        c = c // r**2
        return x.reshape(c, r, r, h, w).transpose(0, 3, 1, 4, 2).reshape(1, c, h * r, w * r)
    squares = x.reshape(c, h // r, r, w // r, r).transpose(0, 2, 4, 1, 3)
    return squares.reshape(1, c * r**2, h // r, w // r)


def encoded(image: np.ndarray) -> np.ndarray:
    """Encode a tile (1, C, h, w) as the planes (1, P, h', w') that the core reads as int8 / 128.

    Each pixel in 12 bits is split into coarse steps, the rest, and the rest in steps of `part`.
    """
    wide = np.pad(image, ((0, 0), (0, 0), *[(S["border_px"],) * 2] * 2), "reflect")
    places = shuffled(wide, S["front"], up=False)
    shares = places * np.array(S["input_factors"], F)[:, None, None]
    dn = np.clip(np.rint(shares * F(4095)), F(S["lowest_dn"]), F(4095)) - F(S["middle"])
    coarse = np.minimum(np.rint(dn * F(1 / S["step"])), F(127))
    rest = dn - coarse * F(S["step"])
    parts = np.rint(rest * F(1 / S["part"]))
    return np.concatenate([coarse] * S["coarse_planes"] + [rest, parts], 1) / F(128)


def fits(fine: np.ndarray) -> np.ndarray:
    """Return True for the values of a copy in fine steps that the limits of int8 do not clip."""
    return np.asarray(np.abs(fine) <= F(S["fine_max"]))


def dual_range(fine: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Merge two copies of a result: where the one in fine steps is clipped, take the coarse one."""
    return np.where(fits(fine), fine, coarse * F(S["gain"]))


def offset_windows(coarse: np.ndarray, *windows: np.ndarray) -> np.ndarray:
    """Merge a coarse copy with fine windows around offsets, of which the last that fits counts."""
    value = coarse * F(S["gain"])
    for window, offset in zip(windows, S["offsets"]):  # noqa: B905 - a board's Python may be old
        value = np.where(fits(window), window + np.array(offset, F)[:, None, None], value)
    return value


def bank_sum(fine: np.ndarray, coarse: np.ndarray, *analytic: np.ndarray) -> np.ndarray:
    """Add the network's correction to the linear restoration, the sum of its analytic copies."""
    added = np.sum(analytic[: S["fine_copies"]], 0) * F(S["fine_gain"])
    # The last copy may be a coarse one, for values at which the others are clipped.
    if S["coarse_gain"]:
        added = np.where(fits(analytic[0]), added, analytic[-1] * F(S["coarse_gain"]))
    return np.asarray(dual_range(fine, coarse) + added)


DECODINGS: dict[str, Any] = {
    "plain": np.asarray,
    "dual range": dual_range,
    "offset windows": offset_windows,
    "bank sum": bank_sum,
}
"""Functions that decode the copies of each channel that a core writes, by the name in host.json."""


ACTIVATIONS: dict[str, Any] = {
    "Sigmoid": lambda values: 0.5 + 0.5 * np.tanh(0.5 * values),
    "Tanh": np.tanh,
}
"""Functions of a decoded result, by the name in host.json."""


def base(image: np.ndarray) -> np.ndarray:
    """Make the base that a result is added to of a tile (1, C, h, w): some channels, enlarged.

    Each row of the weights gives one of the pixels that a pixel becomes along an axis.
    """
    image = image[:, S["added_channels"]]
    weights = np.array(S["enlargement"], F)
    factor, taps = weights.shape
    if factor == 1:
        return image
    # First down, then across.
    for _ in range(2):
        _, channels, height, width = image.shape
        wide = np.pad(image, [(0, 0), (0, 0), (taps // 2, taps // 2), (0, 0)], "edge")
        shifts = [wide[:, :, k : k + height] for k in range(taps)]
        phases = [sum(w * shift for w, shift in zip(phase, shifts)) for phase in weights]  # noqa: B905 - as above
        tall = np.stack(phases, 3).reshape(1, channels, factor * height, width)
        image = tall.swapaxes(2, 3)
    return image


def restored(image: np.ndarray, run: Any, unit: float) -> np.ndarray:
    """Restore a tile (1, C, h, w) by one core: encode it, decode the result, and add the tile.

    `run` computes the core's result from planes. A result of 1 is `unit` of full scale.
    """
    copies = np.split(run(encoded(image)), S["copies"], 1)
    value = DECODINGS[S["decoding"]](*copies)
    if S["activation"]:
        value = ACTIVATIONS[S["activation"]](value.astype(np.float64)).astype(F)
    value = shuffled(value, S["back"], up=True) * F(unit)
    if S["crop_px"]:
        value = value[:, :, S["crop_px"] : -S["crop_px"], S["crop_px"] : -S["crop_px"]]
    if S["adds_image"]:
        value = base(image) + value
    if S["limits"]:
        value = np.clip(value, *S["limits"])
    return shuffled(value, S["last"], up=True)


def exposed(factor: float, image: np.ndarray, run: Any) -> np.ndarray:
    """Restore a tile (1, C, h, w) at `factor` times its light, without the sensor's dark offset."""
    if factor == 1:
        return restored(image, run, UNITS[1])
    multiplied = np.clip((image - DARK) * F(factor) + DARK, 0, F(1))
    result = np.clip(restored(multiplied, run, UNITS[factor]), 0, F(1))
    return np.asarray(np.clip((result - DARK) / F(factor) + DARK, 0, F(1)))


def factors(tile: np.ndarray) -> np.ndarray:
    """Choose the exposure, a factor of brightness, of every pixel (h, w) of a tile (1, C, h, w).

    A pixel gets the largest factor at which no pixel within the network's receptive radius exceeds
    `headroom` and none within `edge_px` differs by `sharpest` from its neighbours; or the smallest.
    """
    smallest, *others = sorted(UNITS)
    choice = np.full(tile.shape[2:], smallest)
    pixels = tile[0, 0]
    sharp = np.abs(pixels - averaged(np.pad(pixels, 1, "edge"), 3, 1))
    sharpest = largest_around(sharp, S["edge_px"])
    brightest = largest_around(pixels, S["halo_px"]) - DARK
    for factor in others:
        suits = sharpest * F(factor) <= F(S["sharpest"][factor > 1])
        if factor > 1:
            suits &= brightest * F(factor) + DARK <= F(S["headroom"])
        choice[suits] = factor
    return choice


def largest_around(pixels: np.ndarray, radius: int) -> np.ndarray:
    """Compute the maximum of the square of `radius` pixels around each pixel (h, w)."""
    size = 2 * radius + 1
    # The maximum of a square is that of its columns' maxima: first down, then across.
    for _ in range(2):
        pixels = np.pad(pixels, [(radius, radius), (0, 0)], "edge")
        length = 1
        # The maximum of two windows that touch or overlap is that of a window twice as long.
        while length < size:
            step = min(length, size - length)
            pixels = np.maximum(pixels[:-step], pixels[step:])
            length = length + step
        pixels = pixels.T
    return pixels


def smoothed(x: np.ndarray) -> np.ndarray:
    """Smooth the noise that the network left in dark parts of a restored band (H, W).

    A guided filter: windows of pixels with less variance than the noise, n, turn to their mean.
    """
    side = S["consistency"]["window_px"]
    dark, growth, square = np.array(S["consistency"]["variances"], F)
    wide = np.pad(x, side // 2 * 2, "symmetric")
    mean = averaged(wide, side, 1)
    light = np.maximum(mean - DARK, F(0))
    n = np.maximum(dark + growth * light + square * light**2, F(0))
    variance = averaged(wide * wide, side, 1) - mean * mean
    rest = n / np.maximum(np.maximum(variance, n), F(1e-30))
    share, mean = (averaged(values, side, 1) for values in (rest, rest * mean))
    return np.asarray(x - share * x + mean)


def consistent(raw: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Smooth a restored band x (H, W) and correct it to x + G (raw - H x), clipped to [0, 1].

    H is the sensor's blur relative to the reference. G computes the means of blocks and
    interpolates between their centres, which retains only low spatial frequencies.
    """
    rows, columns, far, means, excess = (
        np.array(S["consistency"][name], F)
        for name in ("rows", "columns", "far", "means", "excess")
    )
    smooth = smoothed(x)
    # The near part of H x is a sum of separable filters, computed for the means of blocks alone.
    near = extended(smooth, NEAR)
    blurred = sum(summed(near, row, column) for row, column in zip(rows, columns))  # noqa: B905 - as above
    wide = extended(smooth, BLOCK * (len(far) // 2))
    blurred = blurred + around(averaged(wide, BLOCK, BLOCK), far)
    own = averaged(extended(raw, 0), BLOCK, BLOCK)
    # The converter clips noise at zero: that raises the means of dark blocks, and is no error.
    clipped = np.interp(own, means, excess, right=0.0).astype(F)
    residual = own - np.minimum(clipped, np.maximum(own, F(0))) - blurred
    # Blocks that a saturated pixel reaches through the near part of H are left out.
    ones = np.ones(BLOCK + 2 * NEAR, F)
    reached = summed(extended((raw >= 1).astype(F), NEAR), ones, ones) > 0
    usable = (~reached).astype(F)
    share = interpolated(usable, x.shape) if reached.any() else F(1)
    # Where few of the blocks around are usable, the correction fades out.
    change = interpolated(residual * usable, x.shape) / np.maximum(share, F(0.25))
    if S["consistency"]["detail"]:
        change = change + np.where(share == 1, detail(raw, near), F(0))
    return np.asarray(np.clip(x + (change + (smooth - x)), 0, F(1)))


def detail(raw: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Compute the correction (H, W) of finer detail from a raw band and `near`, x extended by NEAR.

    It is the residual of fine blocks without that of the large ones, and 0 at the image's border.
    """
    weights = (np.array(S["consistency"]["detail"][name], F) for name in ("rows", "columns"))
    blurred = sum(summed(near, row, column, FINE) for row, column in zip(*weights))  # noqa: B905 - as above
    residual = averaged(extended(raw, 0), FINE, FINE) - blurred
    large = averaged(residual, BLOCK // FINE, BLOCK // FINE)
    change = interpolated(residual, raw.shape, FINE) - interpolated(large, raw.shape)
    for size in raw.shape:
        low, high = inner(-(-size // BLOCK))
        change[: BLOCK * low] = 0
        change[BLOCK * high :] = 0
        change = change.T
    return np.asarray(change)


def judged(raw: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Compute the self-check of one band (H, W): two figures (2, n, m) of blocks of CHECK pixels.

    The first is chi2, (raw - H x)^2 over the variance of noise, of pixels or of sums over cells.
    The second is the mean of (x - H x)^2 / variance. Both are NaN where too few pixels count.
    """
    facts = S["self_check"]
    kernel = np.array(facts["rows"], F).T @ np.array(facts["columns"], F)
    reach = len(kernel) // 2
    wide = np.pad(x, reach, "symmetric")
    spectrum = np.fft.rfft2(wide) * np.fft.rfft2(kernel, wide.shape)
    blurred = np.fft.irfft2(spectrum, wide.shape)[2 * reach :, 2 * reach :]
    dark, growth, square = facts["variances"]
    light = np.maximum(blurred - S["offset"], 0)
    variance = dark + growth * light + square * light**2
    # Saturated pixels, those close to one, and those at the image's border have no residual.
    counts = largest_around((raw >= 1).astype(F), CLOSE) == 0
    inside = np.pad(counts[CLOSE:-CLOSE, CLOSE:-CLOSE], CLOSE)
    residual = inside * (raw - blurred) / np.sqrt(variance)
    cells, smooth = (
        sums(sums(residual, side) ** 2 / np.maximum(sums(inside, side), 1), CHECK // side)
        for side in (facts["cell"], facts["smooth"])
    )
    smooth = (1 - facts["smooth_weight"]) * smooth
    squares = np.maximum(sums(residual**2, CHECK) - smooth, facts["cell"] ** 2 * (cells - smooth))
    change = sums(inside * (x - blurred) ** 2 / variance, CHECK)
    pixels = sums(inside, CHECK)
    pixels[pixels < CHECK**2 // 2] = np.nan
    return np.asarray(np.stack([squares, change]) / pixels)


def sums(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums of an array (H, W) over squares of `side` x `side` values, (n, m)."""
    down, across = (np.arange(0, length, side) for length in values.shape)
    by_rows = np.add.reduceat(values, down, 0, dtype=float)
    return np.add.reduceat(by_rows, across, 1)


def report(blocks: np.ndarray) -> str:
    """Count the blocks that contradict the raw image, in a sentence; blocks (bands, 2, n, m)."""
    facts = S["self_check"]
    chi2, sharpening = np.moveaxis(blocks, 1, 0)
    outside = chi2 > facts["most_chi2"] + facts["most_per_sharpening"] * sharpening
    decidable = outside | (sharpening >= facts["least_sharpening"])
    return (
        f"self-check: {outside.sum()} of {decidable.sum()} decidable blocks contradict the raw "
        f"image; {np.isfinite(chi2).sum() - decidable.sum()} are too smooth to decide\n"
    )


def extended(x: np.ndarray, margin: int) -> np.ndarray:
    """Mirror an image (H, W) to whole blocks, and by `margin` pixels more on every side."""
    return np.pad(x, [(margin, margin + -size % BLOCK) for size in x.shape], "symmetric")


def summed(x: np.ndarray, row: np.ndarray, column: np.ndarray, side: int = BLOCK) -> np.ndarray:
    """Compute the weighted sum of a window of each block of an image that reaches beyond them."""
    for weights in (row, column):
        end = x.shape[0] - len(weights) + 1
        x = sum(x[place : place + end : side] * weight for place, weight in enumerate(weights)).T
    return x


def averaged(x: np.ndarray, side: int, step: int) -> np.ndarray:
    """Compute the mean of the square of `side` pixels at every `step`-th place along each axis."""
    mean = np.full(side, 1 / side, F)
    return summed(x, mean, mean, step)


def around(means: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Compute the far part of the blur H x: `far` weights the block means around each block."""
    height, width = (size - len(far) + 1 for size in means.shape)
    total = np.zeros((height, width), F)
    for y, weights in enumerate(far):
        for x, weight in enumerate(weights):
            total += weight * means[y : y + height, x : x + width]
    return total


def inner(count: int) -> tuple[int, int]:
    """Return (first, end) of the blocks off the border: of more than 4, without 2 per end."""
    return (2, count - 2) if count > 4 else (0, count)


def interpolated(blocks: np.ndarray, shape: tuple[int, ...], side: int = BLOCK) -> np.ndarray:
    """Interpolate bilinearly between the centres of blocks of `side` pixels, to (H, W) = `shape`.

    Blocks at the border, into which H brings light from outside, count as the nearest one inside.
    """
    for size in shape:
        place = np.arange(size) - side // 2
        low, high = (BLOCK // side * end for end in inner(len(blocks) * side // BLOCK))
        left, right = (np.clip(place // side + k, low, high - 1) for k in (0, 1))
        share = (((2 * place + 1) % (2 * side)).astype(F) / F(2 * side))[:, None]
        blocks = (blocks[left] * (F(1) - share) + blocks[right] * share).T
    return blocks


def known_tile(runs: dict[float, Any], learn: bool) -> None:
    """Restore a drawn tile by each core. Another checksum than in known.json shows a flip."""
    path = HERE / "known.json"
    if not learn and not path.exists():
        return
    size = (1, S["channels"], S["tile_px"], S["tile_px"])
    shares = np.random.default_rng(0).uniform(S["lowest_dn"] / 4095, 1, size)
    tile = (shares / np.array(S["input_factors"])[:, None, None]).astype(F)
    crcs = {f"{f:g}": zlib.crc32(exposed(f, tile, run).tobytes()) for f, run in runs.items()}
    if learn:
        path.write_text(json.dumps(crcs), encoding="utf-8")
    learnt = json.loads(path.read_text(encoding="utf-8"))
    wrong = ", ".join(f"x{factor}" for factor, crc in crcs.items() if learnt.get(factor) != crc)
    if wrong:
        sys.exit(f"known tile: restored otherwise by {wrong}, whose weights must be loaded again")
    sys.stdout.write("known tile: restored as learnt\n")


def spans(size: int, tile: int, halo: int) -> list[tuple[int, int, int]]:
    """Return the start of each tile along `size` pixels, and start and end of what it retains."""
    starts = [*range(0, size - tile, tile - 2 * halo), size - tile]
    return [
        (s, s and s + halo, starts[k + 1] + halo if s < size - tile else size)
        for k, s in enumerate(starts)
    ]


def read_image(source: str) -> np.ndarray:
    """Read an image (C, H, W) of at least a tile, or raise ValueError with the reason."""
    try:
        with Path(source).open("rb") as file:
            image: np.ndarray = np.lib.format.read_array(file).astype(F)
    # The header of a damaged file may lead to anything.
    except Exception as error:
        raise ValueError(f"{source} cannot be read as an array of numbers: {error}") from error
    t = S["tile_px"]
    whole = image.ndim == 3 and len(image) == S["channels"] and min(image.shape[1:]) >= t
    if not whole or not np.isfinite(image).all():
        raise ValueError(
            f"{source} must hold finite values ({S['channels']}, H, W) of at least {t} x {t} "
            f"pixels, got shape {image.shape}."
        )
    if np.median(image * np.array(S["input_factors"], F)[:, None, None]) > 1:
        raise ValueError(f"{source} is mostly above full scale. Divide its values by full scale.")
    return image


def require_output(path: Path, source: str) -> None:
    """Raise ValueError if an output has no place, or would replace the image."""
    if not path.parent.is_dir():
        raise ValueError(f"{path} cannot be written: no such folder. Create it first.")
    if path.is_dir() or (path.exists() and path.samefile(source)):
        raise ValueError(f"{path} is the image or a folder. Choose another name for the result.")


def save(target: Path, values: np.ndarray) -> None:
    """Write an array, whole or not at all."""
    part = target.with_name(f"{target.name}.part")
    try:
        with part.open("wb") as file:
            np.save(file, values)
        part.replace(target)
    except OSError as error:
        raise ValueError(f"{target} cannot be written: {error}. Write elsewhere.") from error
    finally:
        part.unlink(missing_ok=True)


def main(source: str, target: str, runs: dict[float, Any], learn: bool) -> None:
    """Restore the image in `source` into `target`, tile by tile; `runs` has each factor's core."""
    image = read_image(source)
    output = Path(target)
    check_output = output.with_name(f"{output.stem}-check.npy")
    for path in (output, check_output):
        require_output(path, source)
    t = S["tile_px"]
    r = S["scale"]
    wide = np.pad(image, [(0, 0)] + [(0, -n % S["alignment_px"]) for n in image.shape[1:]], "edge")
    down, across = (spans(n, t, S["halo_px"]) for n in wide.shape[1:])
    out = np.empty((S["bands"], *(n * r for n in wide.shape[1:])), F)
    for (y, top, bottom), (x, left, right) in itertools.product(down, across):
        tile = wide[None, :, y : y + t, x : x + t]
        choice = factors(tile)[top - y : bottom - y, left - x : right - x].repeat(r, 0).repeat(r, 1)
        place = out[:, top * r : bottom * r, left * r : right * r]
        for factor in np.unique(choice).tolist():
            result = exposed(factor, tile, runs[factor])[0]
            pixels = result[:, (top - y) * r : (bottom - y) * r, (left - x) * r : (right - x) * r]
            np.copyto(place, pixels, where=choice == factor)
    out = out[:, : image.shape[1] * r, : image.shape[2] * r]
    if S["consistency"]:
        out = np.stack([consistent(raw, np.clip(x, 0, F(1))) for raw, x in zip(image, out)])  # noqa: B905 - as above
    save(output, out)
    if S["self_check"]:
        blocks = np.stack([judged(raw, x) for raw, x in zip(image, out)])  # noqa: B905 - as above
        save(check_output, blocks)
        sys.stdout.write(report(blocks))
    known_tile(runs, learn)


def cores() -> dict[float, Any]:
    """Open the core of each exposure factor in onnxruntime; a board has other runners instead."""
    import onnxruntime as ort

    # onnxruntime's fused kernels may saturate.
    plain = ort.SessionOptions()
    plain.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL

    def opened(factor: float) -> Any:
        name = "core.onnx" if factor == 1 else f"core-x{factor:g}.onnx"
        session = ort.InferenceSession(str(HERE / name), plain, providers=["CPUExecutionProvider"])
        return lambda planes: session.run(None, {"planes": planes})[0]

    return {factor: opened(factor) for factor in UNITS}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Restore an image by the network of this kit.")
    parser.add_argument("image", help=".npy of the raw image (C, H, W)")
    parser.add_argument("restored", help=".npy to write")
    parser.add_argument("--learn", action="store_true", help="write known.json, on the board")
    words = parser.parse_args()
    try:
        main(words.image, words.restored, cores(), words.learn)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"host.py: {error}\n")
        sys.exit(2)
