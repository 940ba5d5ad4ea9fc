"""Regenerate the shipped INT8 files, each for all sensors, calibrated on photographs.

    python docs/make/int8.py --images aerial/ [convbeers-s ...]

It takes minutes a file. A new file has no interval: `python -m benchmarks.interval calibrate`
writes it.
"""

import argparse
from pathlib import Path

from beers_deploy.model.shipped import INT8, shipped_names, shipped_weights
from beers_deploy.network_files import Conditioned
from beers_deploy.profiles.errors import BeersError
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.quant.passes.effort import Effort
from beers_deploy.quantization import family_model

WEIGHTS = Path(__file__).parents[2] / "model" / "weights"


def main() -> None:
    """Regenerate the files that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=shipped_names())
    parser.add_argument(
        "--images", type=Path, required=True, nargs="+", help="folders of photographs"
    )
    arguments = parser.parse_args()
    for name in arguments.names:
        shipped = WEIGHTS / f"{name}{INT8}.onnx"
        network = Conditioned(name, shipped_weights(name))
        try:
            int8 = family_model(network, arguments.images, effort=Effort.best)
        except BeersError as error:
            parser.error(str(error))
        save_onnx(int8, shipped)
        print(shipped.name, flush=True)


if __name__ == "__main__":
    main()
