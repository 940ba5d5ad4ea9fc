"""What boards change of the INT8 files made for each: `python benchmarks/boards.py --images
aerial-train/`.

Every shipped network is calibrated once for each board, on the same patches; each file is checked
on its board and compared with that of the first board, and with the shipped one.
"""

import argparse
import hashlib
import time
from pathlib import Path

import onnx

from beers_deploy.dpu.board import dpu_of
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import network_of
from beers_deploy.model.shipped import INT8, SHIPPED, shipped_names, shipped_weights
from beers_deploy.network_files import Conditioned
from beers_deploy.profiles.shipped import board_names
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.core import target_shifts
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quantization import family_model


def files(images: Path | None, variants: list[str]) -> None:
    """A line a network and board."""
    for variant in variants:
        network = Conditioned(variant, shipped_weights(variant))
        first = ""
        shipped = integers(load_onnx(SHIPPED / f"{variant}{INT8}.onnx"))
        for name in board_names():
            start = time.perf_counter()
            target = TargetProfile.load(name)
            network_family = family_model(
                network, [images] if images else [], shifts=target_shifts(target)
            )
            digest = integers(network_family)
            first = first or digest
            refused = len(place(network_of(network_family, 640), dpu_of(target)).failed)
            print(
                f"{variant:14} {name:8} {time.perf_counter() - start:5.0f} s, nodes refused "
                f"{refused}, "
                f"{digest[:12]}, {'as' if digest == first else 'NOT as'} the first board's, "
                f"{'as' if digest == shipped else 'not as'} shipped",
                flush=True,
            )


def integers(model: onnx.ModelProto) -> str:
    """SHA-256 of a file's graph: what it computes, without what is said beside it."""
    return hashlib.sha256(model.graph.SerializeToString(deterministic=True)).hexdigest()


def main() -> None:
    """All variants on all boards."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--images", type=Path, help="folder of scenes; drawn ones if none")
    parser.add_argument("--variants", nargs="+", default=shipped_names())
    arguments = parser.parse_args()
    files(arguments.images, arguments.variants)


if __name__ == "__main__":
    main()
