"""What each pass of the legal quantisation buys: the gate's figures with all of them, and with each
one left out.

    python benchmarks/ablation.py NETWORK.onnx [--sensor pleiades-degraded] [--images DIR] \
        [--patches 64] [--seed 0]

Patches are those of `quantize`, and the figures those of `gate` on patches that calibration did not
see.
"""

import argparse
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

from beers_deploy.export import float_model
from beers_deploy.network_files import float_file
from beers_deploy.profiles import load_sensor
from beers_deploy.quant.calibration import Calibration
from beers_deploy.quant.gate import compare
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.quantise import quantise_model
from beers_deploy.quant.samples import PATCH_PX
from beers_deploy.quant.session import open_any_size


def ablations() -> Iterator[tuple[str, Passes]]:
    """Return all passes, and all but each one, with their names."""
    yield "all passes", ALL
    for field in fields(Passes):
        yield f"without {field.name}", replace(ALL, **{field.name: False})


def main() -> None:
    """Print a row an ablation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("network", type=Path)
    parser.add_argument("--sensor", default="pleiades-degraded")
    parser.add_argument("--images", type=Path)
    parser.add_argument("--patches", type=int, default=64)
    parser.add_argument("--patch", type=int, default=PATCH_PX)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    model = float_model(float_file(arguments.network, load_sensor(arguments.sensor)))
    calibration = Calibration(
        load_sensor(arguments.sensor),
        arguments.images,
        arguments.patches,
        arguments.patch,
        arguments.seed,
    )
    session = open_any_size(model)
    unseen = calibration.unseen.pairs
    print("| passes | MAE | PSNR drop, dB |\n|---|---|---|")
    for name, passes in ablations():
        made = quantise_model(model, calibration.drawn, {}, passes=passes)
        found = compare(session, open_any_size(made.host), unseen)
        print(f"| {name} | {found.mae:.3g} | {found.drop_db:.3f} |", flush=True)


if __name__ == "__main__":
    main()
