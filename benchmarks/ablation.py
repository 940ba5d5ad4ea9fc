"""What each accuracy pass of the quantiser buys, in dB: the loss with all passes, and how much
larger it is when one is left out.

    python -m benchmarks.ablation --images aerial-train/ --held-out aerial-test/ --keep networks/

The small networks are those of `benchmarks.small_networks`, trained briefly. Shipped
networks are quantised over their range of sensors and judged on `pleiades-degraded`. Prints a
Markdown table; samples that judge were seen by neither training nor calibration.
"""

import argparse
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import onnx

from beers_deploy.model.shipped import SENSOR, shipped_names, shipped_weights
from beers_deploy.network_files import Conditioned, int8_for_sensor
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.calibration import unseen_patches
from beers_deploy.quant.gate import compare
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples import samples_of
from beers_deploy.quant.session import open_any_size, open_session, result_of
from beers_deploy.quantization import family_model
from benchmarks.small_networks import NETWORKS, SIDE_PX, Drawn, losses, save, slug, trained

Loss = Callable[[Passes], float]
"""Quantises a network with these passes; the mean loss of PSNR in dB."""
UNSEEN = 64
"""Patches that judge a shipped network."""
NOT_BEHIND_A_BANK = {"dual_range"}
"""Passes without effect there: the result has two ranges of its own."""
SAME_DB = 5e-4
"""A smaller change is none: it is printed as 0.000."""


def ablations() -> Iterator[tuple[str, Passes]]:
    """Return the passes with each single one left out, by its name."""
    for field in fields(Passes):
        yield field.name, replace(ALL, **{field.name: False})


def row(loss_of: Loss, behind_bank: bool = False) -> list[str]:
    """Return the loss with all passes, and what each one buys: the loss without it, less the loss
    with it.
    """
    loss = loss_of(ALL)
    cells = [f"{loss:.3f}"]
    for name, passes in ablations():
        if behind_bank and name in NOT_BEHIND_A_BANK:
            cells.append("-")
            continue
        gain = loss_of(passes) - loss
        cells.append("0" if abs(gain) < SAME_DB else f"{gain:+.3f}")
    return cells


def small(name: str, arguments: argparse.Namespace, folder: Path) -> Loss:
    """Return the loss of a small network, which is trained unless the folder has it."""
    kind, _ = NETWORKS[name]
    path = folder / f"{slug(name)}.onnx"
    if not path.exists():
        side_px = SIDE_PX[kind] // (2 if kind == "espcn" else 1)
        save(trained(name, arguments.images, arguments.steps), side_px, path)
    model = load_onnx(path)
    samples = samples_of(model, Drawn.of(kind, arguments.images, 5, arguments.batches).images)
    assert samples is not None  # noqa: S101 - some were given
    patches = samples.drawn
    held = Drawn.of(kind, arguments.held_out, 6, arguments.batches)
    in_float = partial(result_of, open_session(model))

    def loss_of(passes: Passes) -> float:
        host = quantize_model(model, patches, {}, passes=passes).host
        in_int8 = partial(result_of, open_session(host))
        return float(losses(in_float, in_int8, held).mean())

    return loss_of


def shipped(name: str, arguments: argparse.Namespace) -> Loss:
    """Return the loss of a shipped network behind the bank of one sensor."""
    network = Conditioned(name, shipped_weights(name))
    sensor = Sensor.load(SENSOR)
    float_session = open_any_size(network.model(sensor, int8=False))
    pairs = unseen_patches(sensor, arguments.held_out, UNSEEN, 0).pairs
    folders = [arguments.images] if arguments.images else []

    def loss_of(passes: Passes) -> float:
        family: onnx.ModelProto = family_model(network, folders, passes=passes)
        int8 = open_any_size(int8_for_sensor(family, sensor))
        return float(compare(float_session, int8, pairs).drop_db)

    return loss_of


def main() -> None:
    """Print a row a network, as each is done."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, help="folder of photographs to train on")
    parser.add_argument("--held-out", type=Path, help="folder of photographs to judge on")
    parser.add_argument("--steps", type=int, default=1500, help="of training a small network")
    parser.add_argument("--batches", type=int, default=8, help="of eight samples each")
    parser.add_argument("--only", default="", help="networks whose names this expression finds")
    parser.add_argument("--keep", type=Path, help="folder of the small networks")
    arguments = parser.parse_args()
    names = [*NETWORKS, *shipped_names()]
    print(f"| network | all | {' | '.join(field.name for field in fields(Passes))} |")
    print("|---" * (len(fields(Passes)) + 2) + "|")
    with TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            if not re.search(arguments.only, name):
                continue
            if name in NETWORKS:
                cells = row(small(name, arguments, folder))
            else:
                cells = row(shipped(name, arguments), behind_bank=True)
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
