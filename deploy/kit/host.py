#!/usr/bin/env python3
"""The host's part of a network on a board: python3 host.py image.npy restored.npy, float32 (C, H, W) in [0, 1].

It needs NumPy, host.json and, for core.onnx, onnxruntime: on a board put its own runner into `run`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

F, HERE = np.float32, Path(__file__).parent
S = json.loads((HERE / "host.json").read_text(encoding="utf-8"))


def shuffled(x: np.ndarray, r: int, up: bool) -> np.ndarray:
    """Pixels (1, C, H, W) into r^2 times the channels; `up`, back."""
    _, c, h, w = x.shape
    if up:
        return x.reshape(c // r**2, r, r, h, w).transpose(0, 3, 1, 4, 2).reshape(1, c // r**2, h * r, w * r)
    return x.reshape(c, h // r, r, w // r, r).transpose(0, 2, 4, 1, 3).reshape(1, c * r**2, h // r, w // r)


def restored(image: np.ndarray, run: Any) -> np.ndarray:
    """A tile (1, C, h, w): planes in whole multiples of 1/128 to the core, its result merged, added and clipped."""
    wide = np.pad(image, ((0, 0), (0, 0), *[(S["border_px"],) * 2] * 2), "reflect")
    dn = np.clip(np.rint(shuffled(wide, S["front"], up=False) * F(4095)), 0, F(4095)) - F(S["middle"])
    coarse = np.minimum(np.rint(dn * F(1 / S["step"])), F(127))
    rest = dn - coarse * F(S["step"])
    result = run(np.concatenate([coarse] * S["coarse"] + [rest, np.rint(rest * F(1 / S["part"]))], 1) / F(128))
    value, *others = np.split(result, S["copies"], 1)
    if S["offsets"]:  # coarse, and windows that hold fine what lies within them
        value = value * F(8)
        for window, offset in zip(others, S["offsets"]):  # noqa: B905 - a board's Python may be old
            value = np.where(np.abs(window) <= F(S["fine_max"]), window + np.array(offset, F)[:, None, None], value)
    elif others:  # fine, coarse, and the copies of the analytic restoration
        value = np.where(np.abs(value) <= F(S["fine_max"]), value, others[0] * F(8))
        value = value + np.sum(others[1:], 0) * F(S["analytic"]) if others[1:] else value
    value = shuffled(value, S["back"], up=True) * F(S["unit"])
    return shuffled(np.asarray(np.clip(image + value, 0, 1) if S["adds_image"] else value), S["last"], up=True)


def spans(size: int, tile: int, halo: int) -> list[tuple[int, int, int]]:
    """Of each tile along a side: where it begins, and the first and last of the pixels that are kept of it."""
    starts = [*range(0, size - tile, tile - 2 * halo), size - tile]
    return [(s, s and s + halo, starts[k + 1] + halo if s < size - tile else size) for k, s in enumerate(starts)]


def main(source: str, target: str, run: Any) -> None:
    """Restore an image of at least a tile, tile by tile."""
    image, t, r = np.load(source).astype(F), S["tile_px"], S["scale"]
    wide = np.pad(image, [(0, 0)] + [(0, -n % S["lattice_px"]) for n in image.shape[1:]], "edge")
    down, across = (spans(n, t, S["halo_px"]) for n in wide.shape[1:])
    out = np.empty((S["bands"], *(n * r for n in wide.shape[1:])), F)
    for (y, top, bottom), (x, left, right) in ((a, b) for a in down for b in across):
        tile = restored(wide[None, :, y : y + t, x : x + t], run)[0]
        kept = slice((top - y) * r, (bottom - y) * r), slice((left - x) * r, (right - x) * r)
        out[:, top * r : bottom * r, left * r : right * r] = tile[:, kept[0], kept[1]]
    np.save(target, out[:, : image.shape[1] * r, : image.shape[2] * r])


if __name__ == "__main__":
    import onnxruntime as ort

    plain = ort.SessionOptions()
    plain.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL  # fused kernels may saturate
    session = ort.InferenceSession(str(HERE / "core.onnx"), plain, providers=["CPUExecutionProvider"])
    main(sys.argv[1], sys.argv[2], lambda planes: session.run(None, {"planes": planes})[0])
