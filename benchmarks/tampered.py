"""Seventeen ways to tamper with the integers of an INT8 file, and which of them the gate stops.

    python benchmarks/tampered.py float.onnx int8.onnx [--baseline]

Each tampered file is consistent in itself: its host part, ReLUs and scales fit its integers, so
only its results can give it away. Prints a Markdown table: the PSNR that it loses over the
untampered file, the checks that fail with the default limits, and those that fail with a baseline
of the untampered file.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from beers_deploy.network import Network
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import host_model, read_core
from beers_deploy.quant.onnx_file import fixed_tile_px, load_onnx, metadata
from beers_deploy.verbs.gate import gate

Change = Callable[[IntConv], IntConv]


def weights(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return a change of the int8 weights (O, I, kh, kw)."""
    return lambda conv: replace(conv, weight=_int8(change(conv.weight.astype(np.int64))))


def bias(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return a change of the int8 bias (O,)."""
    return lambda conv: replace(conv, bias=_int8(change(conv.bias.astype(np.int64))))


def _int8(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(values, -128, 127), np.int8)


def without_channel(weight: np.ndarray, axis: int) -> np.ndarray:
    """Set the strongest channel to zero."""
    others = tuple(k for k in range(weight.ndim) if k != axis)
    strongest = int(np.argmax(np.abs(weight).sum(others)))
    changed = weight.copy()
    changed[(slice(None),) * axis + (strongest,)] = 0
    return changed


def negated(weight: np.ndarray) -> np.ndarray:
    """Negate the strongest filter."""
    strongest = int(np.argmax(np.abs(weight).sum((1, 2, 3))))
    changed = weight.copy()
    changed[strongest] *= -1
    return changed


def swapped(weight: np.ndarray) -> np.ndarray:
    """Exchange the first two filters, or rows of the kernel if there is only one filter."""
    if len(weight) > 1:
        return weight[[1, 0, *range(2, len(weight))]]
    return weight[:, :, ::-1]


TAMPERINGS: list[tuple[str, float, Change]] = [
    ("bias doubled, first layer", 0.0, bias(lambda b: 2 * b)),
    ("bias doubled, middle layer", 0.5, bias(lambda b: 2 * b)),
    ("bias doubled, last layer", 1.0, bias(lambda b: 2 * b)),
    ("bias removed, first layer", 0.0, bias(np.zeros_like)),
    ("bias removed, middle layer", 0.5, bias(np.zeros_like)),
    ("bias removed, last layer", 1.0, bias(np.zeros_like)),
    ("bias + 1 unit, middle layer", 0.5, bias(lambda b: b + 1)),
    ("strongest filter removed, first layer", 0.0, weights(lambda w: without_channel(w, 0))),
    ("strongest filter removed, middle layer", 0.5, weights(lambda w: without_channel(w, 0))),
    ("strongest input removed, last layer", 1.0, weights(lambda w: without_channel(w, 1))),
    ("strongest filter negated, middle layer", 0.5, weights(negated)),
    ("two filters exchanged, middle layer", 0.5, weights(swapped)),
    ("two filters exchanged, first layer", 0.0, weights(swapped)),
    ("last 2 bits of the weights cleared, middle layer", 0.5, weights(lambda w: w & ~3)),
    ("last 3 bits of the weights cleared, middle layer", 0.5, weights(lambda w: w & ~7)),
    ("weights clipped to 6 bits, middle layer", 0.5, weights(lambda w: np.clip(w, -32, 31))),
    ("weights - 1, last layer", 1.0, weights(lambda w: w - 1)),
]
"""Name, place of the layer from 0 (first) to 1 (last), and the change."""


def tampered(core: IntCore, place: float, change: Change) -> IntCore:
    """Return a core with one changed convolution."""
    numbers = [k for k, op in enumerate(core.ops) if isinstance(op, IntConv)]
    number = numbers[round(place * (len(numbers) - 1))]
    ops = list(core.ops)
    ops[number] = change(ops[number])  # type: ignore[arg-type]
    return replace(core, ops=tuple(ops))


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
    untampered = gate(floating, arguments.int8, progress=False)
    print(f"untampered: {untampered.verdict}\n")
    print("| tampering | further loss, dB | default limits | with a baseline |\n|---|---|---|---|")
    stopped = {"default": 0, "baseline": 0}
    with TemporaryDirectory() as folder:
        baseline = untampered.save(Path(folder) / "baseline.json")
        for name, place, change in TAMPERINGS:
            other = host_model(tampered(core, place, change), metadata(model), fixed_tile_px(model))
            verdict = gate(floating, Network(other, "tampered"), baseline=baseline, progress=False)
            lost_db = (
                untampered.comparison.result.psnr_int8_db - verdict.comparison.result.psnr_int8_db
            )
            failed = [check.name for check in verdict.failed]
            by_default = [check for check in failed if "baseline" not in check]
            stopped["default"] += bool(by_default)
            stopped["baseline"] += bool(failed)
            print(
                f"| {name} | {lost_db:.2f} | {', '.join(by_default) or '-'} | "
                f"{', '.join(failed) or '-'} |",
                flush=True,
            )
    undetected = {key: len(TAMPERINGS) - count for key, count in stopped.items()}
    print(
        f"\nPassed: {undetected['default']} of {len(TAMPERINGS)} by default, "
        f"{undetected['baseline']} with a baseline."
    )


if __name__ == "__main__":
    main()
