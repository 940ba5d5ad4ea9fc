"""What each pass of the legal quantisation buys: the gate's figures with all of them, and with each one left out.

    python benchmarks/ablation.py NETWORK.onnx [--sensor pleiades-degraded] [--images DIR] [--patches 64] [--seed 0]

A pass is left out by what stands in its place here; patches are those of `quantize`, and the figures those of `gate`
on patches that calibration did not see.
"""

import argparse
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from unittest.mock import patch

import numpy as np

from beers_deploy.export import float_model
from beers_deploy.network_files import float_file
from beers_deploy.profiles import load_sensor
from beers_deploy.quant.calibration import Calibration
from beers_deploy.quant.gate import compare
from beers_deploy.quant.passes.equalise import first_guess
from beers_deploy.quant.quantise import quantise_model
from beers_deploy.quant.samples import PATCH_PX
from beers_deploy.quant.session import open_any_size

ALL, PAIR = "all passes", "without half-LSB pair"


def ablations() -> Iterator[tuple[str, AbstractContextManager[object]]]:
    """Each ablation, and what leaves the pass out while it is entered."""
    yield ALL, nullcontext()
    yield PAIR, nullcontext()  # an argument of quantise_model
    yield "without dual-range output", patch("beers_deploy.quant.quantise.takes_gains", lambda _graph: False)
    yield "without fitted weights", patch("beers_deploy.quant.quantise.fit_weights", lambda _graph, core, *_: core)
    yield "without least-squares scales", patch("beers_deploy.quant.calibration._errors", lambda *_: np.zeros(1))
    yield "without tensors from -128 on", patch("beers_deploy.quant.quantise.lower", lambda graph, *_: graph)
    yield "without copies", patch("beers_deploy.quant.quantise.with_copies", lambda graph, *_: (graph, {}))
    yield (
        "without equalising",  # one factor for all channels, with which the largest range fits
        patch(
            "beers_deploy.quant.quantise.search",
            lambda _graph, _stream, ranges, _trial: first_guess(ranges, 0.0, 1.0),
        ),
    )


def main() -> None:
    """Print a row an ablation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", type=Path)
    parser.add_argument("--sensor", default="pleiades-degraded")
    parser.add_argument("--images", type=Path)
    parser.add_argument("--patches", type=int, default=64)
    parser.add_argument("--patch", type=int, default=PATCH_PX)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    model = float_model(float_file(given.network, load_sensor(given.sensor)))
    calibration = Calibration(load_sensor(given.sensor), given.images, given.patches, given.patch, given.seed)
    session = open_any_size(model)
    unseen = calibration.unseen.pairs
    print("| passes | MAE | PSNR drop, dB |\n|---|---|---|")
    for name, left_out in ablations():
        with left_out:
            made = quantise_model(model, calibration.drawn, {}, pairs=name != PAIR)
        found = compare(session, open_any_size(made.host), unseen)
        print(f"| {name} | {found.mae:.3g} | {found.drop_db:.3f} |", flush=True)


if __name__ == "__main__":
    main()
