"""Tamper with the integers of an INT8 file in seventeen ways, and report which of them the gate
stops.

    python benchmarks/tampered.py float.onnx int8.onnx

Each tampered file is consistent in itself: its host part, ReLUs and scales match its integers, so
only its results can reveal it. The script prints a Markdown table: the loss of PSNR relative to the
untampered file, and the verdict of the gate with the default limits and with a baseline.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

import beers_deploy as bd
from beers_deploy.network import Network
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import host_model, read_core
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import load_onnx, metadata

Change = Callable[[np.ndarray], np.ndarray]
Numbers = Literal["weight", "bias"]
"""Weights (O, I, kh, kw) or bias (O,)."""


def strongest_times(factor: int, axis: int = 0) -> Change:
    """Return a change that multiplies the strongest filter (axis 0) or the strongest input (axis 1)
    by a factor.
    """

    def change(weight: np.ndarray) -> np.ndarray:
        others = tuple(k for k in range(weight.ndim) if k != axis)
        strongest = np.abs(weight).sum(others).argmax()
        np.moveaxis(weight, axis, 0)[strongest] *= factor
        return weight

    return change


def exchanged(weight: np.ndarray) -> np.ndarray:
    """Exchange the first two filters."""
    return weight[[1, 0, *range(2, len(weight))]]


TAMPERINGS: list[tuple[str, float, Numbers, Change]] = [
    ("bias doubled, first layer", 0.0, "bias", lambda b: 2 * b),
    ("bias doubled, middle layer", 0.5, "bias", lambda b: 2 * b),
    ("bias doubled, last layer", 1.0, "bias", lambda b: 2 * b),
    ("bias removed, first layer", 0.0, "bias", np.zeros_like),
    ("bias removed, middle layer", 0.5, "bias", np.zeros_like),
    ("bias removed, last layer", 1.0, "bias", np.zeros_like),
    ("bias + 1 unit, middle layer", 0.5, "bias", lambda b: b + 1),
    ("strongest filter removed, first layer", 0.0, "weight", strongest_times(0)),
    ("strongest filter removed, middle layer", 0.5, "weight", strongest_times(0)),
    ("strongest input removed, last layer", 1.0, "weight", strongest_times(0, axis=1)),
    ("strongest filter negated, middle layer", 0.5, "weight", strongest_times(-1)),
    ("two filters exchanged, middle layer", 0.5, "weight", exchanged),
    ("two filters exchanged, first layer", 0.0, "weight", exchanged),
    ("last 2 bits of the weights cleared, middle layer", 0.5, "weight", lambda w: w & ~3),
    ("last 3 bits of the weights cleared, middle layer", 0.5, "weight", lambda w: w & ~7),
    ("weights clipped to 6 bits, middle layer", 0.5, "weight", lambda w: np.clip(w, -32, 31)),
    ("weights - 1, last layer", 1.0, "weight", lambda w: w - 1),
]
"""The name, the place of the layer from 0 (first) to 1 (last), and the change of its int64
numbers."""


def tampered(core: IntCore, place: float, numbers: Numbers, change: Change) -> IntCore:
    """Return a core with one changed convolution."""
    convolutions = [op for op in core.ops if isinstance(op, IntConv)]
    conv = convolutions[round(place * (len(convolutions) - 1))]
    values = change(getattr(conv, numbers).astype(np.int64))
    other = replace(conv, **{numbers: np.clip(values, -128, 127).astype(np.int8)})  # type: ignore[arg-type]
    return replace(core, ops=tuple(other if op is conv else op for op in core.ops))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("floating", type=Path)
    parser.add_argument("int8", type=Path)
    arguments = parser.parse_args()
    model = load_onnx(arguments.int8)
    core = read_core(model)
    floating = Network.load(arguments.floating)
    untampered = bd.gate(floating, arguments.int8, progress=False)
    psnr_db = untampered.comparison.result.psnr_int8_db
    print("| tampering | further loss, dB | default limits | with a baseline |\n|---|---|---|---|")
    with TemporaryDirectory() as folder:
        baseline = untampered.save(Path(folder) / "baseline.json")
        for name, place, numbers, change in TAMPERINGS:
            other = tampered(core, place, numbers, change)
            network = Network(host_model(other, metadata(model), fixed_tile_px(model)), "tampered")
            verdict = bd.gate(floating, network, baseline=baseline, progress=False)
            lost_db = psnr_db - verdict.comparison.result.psnr_int8_db
            failed = [check.name for check in verdict.failed]
            by_default = any("baseline" not in check for check in failed)
            words = ["stopped" if each else "passes" for each in (by_default, bool(failed))]
            print(f"| {name} | {lost_db:.2f} | {' | '.join(words)} |", flush=True)


if __name__ == "__main__":
    main()
