"""Measure what each accuracy pass of the quantiser gains, in dB: the loss with all passes, and how
much larger it is when one is left out.

    python -m benchmarks.ablation --images aerial-train/ --held-out aerial-test/

The small networks are those of `benchmarks.small_networks`, trained briefly. Shipped networks are
quantised over their range of sensors and evaluated on `pleiades-degraded`. The script prints a
Markdown table. The samples it evaluates on were seen by neither training nor calibration.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import onnx

from beers_deploy.model.shipped import SENSOR, shipped_names, shipped_weights
from beers_deploy.network_files import Conditioned, int8_for_sensor
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.gate import compare
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples.own import samples_of
from beers_deploy.quant.samples.simulated import unseen_patches
from beers_deploy.quant.session import open_any_size
from beers_deploy.quantization import family_model
from benchmarks.small_networks import NETWORKS, Small, names_in, options, prepared

Loss = Callable[[Passes], float]
"""Quantise a network with these passes and return its mean loss of PSNR in dB."""
UNSEEN = 64
"""The number of patches on which a shipped network is evaluated."""
NOT_BEHIND_A_BANK = {"dual_range"}
"""Passes without effect behind a filter bank, because its result has two ranges of its own."""
SAME_DB = 5e-4
"""Smaller changes count as none and are printed as 0.000."""


def ablations() -> Iterator[tuple[str, Passes]]:
    """Yield all passes, then the passes with each single one left out, by name."""
    for field in fields(Passes):
        yield field.name, replace(ALL, **{field.name: False})


def row(loss_of: Loss, behind_bank: bool = False) -> list[str]:
    """Return the loss with all passes, and the gain of each one: the loss without it minus the loss
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


def small(network: Small) -> Loss:
    """Return the loss of a small network."""
    model = load_onnx(network.path)
    samples = samples_of(model, network.samples.images)
    assert samples is not None  # noqa: S101 - some were given
    patches = samples.drawn
    int8 = network.path.with_suffix(".int8.onnx")

    def loss_of(passes: Passes) -> float:
        save_onnx(quantize_model(model, patches, {}, passes=passes, brightens=True).host, int8)
        return float(network.losses_db(int8).mean())

    return loss_of


def shipped(name: str, arguments: argparse.Namespace) -> Loss:
    """Return the loss of a shipped network behind the bank of one sensor."""
    network = Conditioned(name, shipped_weights(name))
    sensor = Sensor.load(SENSOR)
    float_session = open_any_size(network.model(sensor, int8=False))
    unseen = unseen_patches(sensor, arguments.held_out, UNSEEN, 0)
    folders = [arguments.images] if arguments.images else []

    def loss_of(passes: Passes) -> float:
        family: onnx.ModelProto = family_model(network, folders, passes=passes)
        int8 = open_any_size(int8_for_sensor(family, sensor))
        return float(compare(float_session, int8, unseen).drop_db)

    return loss_of


def main() -> None:
    """Print one row for each network as soon as it is done."""
    arguments = options(__doc__).parse_args()
    print(f"| network | all | {' | '.join(field.name for field in fields(Passes))} |")
    print("|---" * (len(fields(Passes)) + 2) + "|")
    with TemporaryDirectory() as temporary:
        for name in names_in(arguments, *shipped_names()):
            if name in NETWORKS:
                cells = row(small(prepared(name, arguments, Path(temporary))))
            else:
                cells = row(shipped(name, arguments), behind_bank=True)
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
