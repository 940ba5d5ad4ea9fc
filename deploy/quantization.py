"""The steps of `quantize`: calibration, for one network or over a family of sensors, and the
analysis of the INT8 error.
"""

import os
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import onnx

from beers_deploy.comparison import Data
from beers_deploy.model.bank import bank_of_vector
from beers_deploy.model.family import RANGES
from beers_deploy.model.io.files import sha256
from beers_deploy.model.io.tensors import read_conditioned
from beers_deploy.model.progress import progress, step
from beers_deploy.network import Network, NetworkLike
from beers_deploy.network_files import Conditioned, conditioned, int8_for_sensor
from beers_deploy.profiles.errors import ModelError, OptionError, optional, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE, board_names, npu_names
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.adapt.adaptation import ADAPTED, Adapted, adapt
from beers_deploy.quant.core import SHIFTS, Shifts, target_shifts
from beers_deploy.quant.encodings import host_model, read_core
from beers_deploy.quant.gate import GateResult, compare, gate_row
from beers_deploy.quant.integer.reference import integer_rows
from beers_deploy.quant.onnx_file import faults_named, load_onnx, metadata, require_quantized
from beers_deploy.quant.passes.effort import Effort
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples.own import OwnSamples
from beers_deploy.quant.sensitivity import (
    WORST,
    headline,
    layer_error_rows,
    sizes_row,
    worst_row,
)
from beers_deploy.quant.sensor_bank.conditioned import (
    SENSOR_BIASES,
    WEIGHTS,
    required_conditioned_core,
)
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.untrusted import contradictions
from beers_deploy.report.page import Report
from beers_deploy.report.sensitivity_page import sensitivity_page

if TYPE_CHECKING:
    from beers_deploy.model.convbeers import Rounding
    from beers_deploy.quant.samples.patches import Patches
    from beers_deploy.quant.samples.simulated import Calibration

Source: TypeAlias = "Calibration | OwnSamples"
"""The source of patches: simulated ones, or the user's own."""

MOST_DIGITS = 9


def steps_of(finetune: int | str) -> int | None:
    """Return the steps of fine-tuning, or None for "auto"."""
    if finetune == "auto":
        return None
    text = str(finetune)
    # Python refuses to read numbers of thousands of digits.
    if not text.isdecimal() or len(text) > MOST_DIGITS:
        raise OptionError(
            "`finetune` must be 'auto' or a whole number of steps from 0, but it is "
            f"{printable(repr(finetune))}. Choose 'auto'."
        )
    return int(text)


def quantized(
    network: NetworkLike,
    data: Data,
    target: TargetProfile,
    finetune: int | str,
    effort: Effort = Effort.normal,
    adapts: bool = False,
    output: str | None = None,
) -> tuple[Network, "Patches | None"]:
    """Quantise a float network. The INT8 network refers to it as its `origin`.

    The samples held out from calibration are also returned. They are None for a network that is
    calibrated over the family of sensors.

    Args:
        network: float network, a shipped name, or weights that are conditioned on a sensor.
        data: the data it is calibrated on.
        target: the board whose rules apply.
        finetune: steps that train the integers, or "auto".
        effort: the effort of the search for equalization factors.
        adapts: replace operators that the DPU lacks.
        output: name of the output to retain; None for the only one.

    Raises:
        ModelError: the DPU does not compute an operation.
        OptionError: samples or fine-tuning are given for a network that is conditioned on its
            sensor.
        ImageError: the network does not accept the samples.
    """
    weights = conditioned(Path(network)) if isinstance(network, str | os.PathLike) else None
    steps = steps_of(finetune)
    if weights and (steps != 0 or data.samples is not None):
        unfit = "`finetune`" if data.samples is None else "`samples`"
        raise OptionError(
            f"{unfit} cannot be combined with {weights.name}, because a network conditioned on a "
            f"sensor is calibrated over the whole family of sensors at once. Leave {unfit} out."
        )
    if weights and adapts:
        raise OptionError(
            f"`adapt` has no effect on {weights.name}, because a DPU computes all its operators. "
            "Leave `adapt` out."
        )
    origin = Network.load(network, sensor=data.sensor).with_output(output)
    require_quantized(origin.model, origin.label, expected=False)
    with faults_named(origin.label):
        if weights:
            int8 = quantize_conditioned(
                weights, origin, data.simulated, data.sensor, target, effort
            )
            return int8, None
        # Samples in memory may be given one after the other, so they are read only here.
        source = data.own(origin) or data.simulated
        return quantize_alone(origin, source, target, steps, effort, adapts), source.unseen


def quantize_alone(
    origin: Network,
    calibration: Source,
    target: TargetProfile,
    steps: int | None,
    effort: Effort,
    adapts: bool = False,
) -> Network:
    """Quantise a network for one sensor, with its own calibration.

    Args:
        origin: the float network.
        calibration: patches or samples.
        target: the board whose rules apply.
        steps: the steps of fine-tuning; None to continue while it helps, 0 for none.
        effort: the effort of the search for equalization factors.
        adapts: replace operators that the DPU lacks. The result is compared with `origin` as it is.

    Returns:
        The INT8 network, with statistics of each layer.
    """
    shifts = _shifts_of(target)
    tuning = None
    if steps != 0:
        optional("torch", "finetune")
        from beers_deploy.quant.passes.finetune import Tuning

        # The integers learn the results of the network that was given, not of the adapted one.
        original = origin.model if adapts else None
        tuning = Tuning(calibration.for_tuning.pairs, steps, original=original)
    with progress("calibrating"):
        about = {**calibration.about, "target": target.name}
        adapted = Adapted(origin.model)
        if adapts:
            adapted = adapt(origin.model, calibration.drawn, calibration.unseen)
            about |= {ADAPTED: adapted.record} if adapted.record else {}
        result = quantize_model(
            adapted.model, calibration.drawn, about, shifts, tuning, effort=effort
        )
        step("statistics of each layer")
        layers = integer_rows(origin.model, result.core, result.host, calibration.drawn.degraded)
    return Network(
        result.host,
        f"{origin.name}-int8",
        origin=origin,
        layers=(*adapted.rows, *layers),
        quantized=result,
    )


def quantize_conditioned(
    network: Conditioned,
    origin: Network,
    calibration: "Calibration",
    sensor: Sensor,
    target: TargetProfile,
    effort: Effort,
) -> Network:
    """Quantise a sensor-conditioned network for all sensors of the trained range.

    Args:
        network: the sensor-conditioned weights.
        origin: the float network for `sensor`.
        calibration: where images and patches come from. Its patches also give the statistics of
            each layer.
        sensor: the sensor that the result is conditioned on.
        target: the board whose rules apply.
        effort: the effort of the search for equalization factors.

    Returns:
        The INT8 network for `sensor`, with statistics of each layer.
    """
    images = [] if calibration.images is None else [calibration.images]
    family = family_model(network, images, calibration.seed, _shifts_of(target), effort=effort)
    host = int8_for_sensor(family, sensor, {"target": target.name})
    layers = integer_rows(origin.model, read_core(host), host, calibration.drawn.degraded)
    return Network(host, f"{network.name}-int8", origin=origin, layers=layers)


def _shifts_of(target: TargetProfile) -> Shifts:
    if not (target.configurations or target.npu):
        raise OptionError(
            f"`target` must have a DPU or NPU, but {target.name!r} has none. Choose one of "
            f"{', '.join(board_names() + npu_names())}."
        )
    return target_shifts(target)


def differences_of(network: Network, held_out: "Patches") -> GateResult:
    """Return the differences between INT8 and float for a network that was quantised here.

    Args:
        network: the INT8 one.
        held_out: the samples held out from calibration.
    """
    assert network.origin is not None  # noqa: S101
    return compare(open_any_size(network.origin.model), open_any_size(network.model), held_out)


def sensitivity_report(
    network: Network, held_out: "Patches", differences: GateResult, prices: Sequence[Row]
) -> tuple[list[Row], Report]:
    """Return the sources of the INT8 error on the samples held out from calibration, as rows and a
    page.

    Args:
        network: a network that was quantised here.
        held_out: the samples.
        differences: the differences measured on them.
        prices: the rows of `price_rows`, which the page shows as well.
    """
    assert network.origin is not None and network.quantized is not None  # noqa: S101, PT018
    worst = differences.spread.worst(WORST)
    layers = layer_error_rows(network.quantized, held_out)
    rows = [
        gate_row(differences),
        *layers,
        *(worst_row(k, held_out, differences.spread) for k in worst),
        sizes_row(differences.spread),
    ]
    sessions = open_any_size(network.origin.model), open_any_size(network.model)
    return rows, sensitivity_page(
        headline(differences, layers),
        [*rows, *prices, *network.layers],
        differences.spread,
        held_out,
        sessions,
        worst,
    )


def rounding_of(int8: Path, weights: Path) -> "Rounding":
    """Return how the INT8 file of a conditioned network rounds its maps.

    Raises:
        ModelError: it was made from other weights.
    """
    import torch

    from beers_deploy.model.convbeers import Rounding
    from beers_deploy.quant.sensor_bank.calibrate import map_steps

    model = load_onnx(int8)
    tensors = read_conditioned(weights)
    if metadata(model).get(WEIGHTS) != sha256(weights):
        raise ModelError(
            f"{int8} is the INT8 file of another network than {weights}. Make it with "
            "'beers-deploy quantize'."
        )
    with contradictions(str(int8)):
        step_sizes = map_steps(required_conditioned_core(model), tensors)
    stream, *inner = (torch.from_numpy(np.float32(steps))[:, None, None] for steps in step_sizes)
    return Rounding(stream, tuple(inner))


def family_model(
    network: Conditioned,
    images: Sequence[Path] = (),
    seed: int = 0,
    shifts: Shifts = SHIFTS,
    passes: Passes = ALL,
    effort: Effort = Effort.normal,
) -> onnx.ModelProto:
    """Quantise a conditioned network over the family of sensors, and return its INT8 file for the
    middle of the family.

    Args:
        network: weights that 'train --conditioned' wrote.
        images: folders of photographs, to which about the same number of drawn scenes is added. If
            empty, only drawn scenes are used.
        seed: the seed of the patches.
        shifts: the shift limits of the target.
        passes: the passes that reduce the error.
        effort: the effort of the search for equalization factors.
    """
    # This loads SciPy, which samples of one's own do without.
    from beers_deploy.model.simulator.procedural import load_scenes
    from beers_deploy.quant.sensor_bank.calibrate import bank_images, quantize_behind_bank

    weights = read_conditioned(network.weights)
    aim = Sensor.load(REFERENCE).nominal()
    scale = weights.variant.scale
    scenes = load_scenes(None, aim, seed)
    # Drawn scenes have stronger edges, photographs finer ground, so both are calibrated on.
    if images:
        photographs = list(chain.from_iterable(load_scenes(folder, aim, seed) for folder in images))
        scenes = photographs + scenes * max(len(photographs) // len(scenes), 1)
    with progress(f"calibrating {network.name} over the family of sensors"):
        patches = bank_images(scenes, scale, seed, weights.kernels)
        middle = bank_of_vector((0.0,) * len(RANGES), weights.kernels)
        quantized = quantize_behind_bank(weights, middle, patches, shifts, passes, effort)
    description = {
        "variant": network.name,
        "reference": REFERENCE,
        "precision": "int8 legal",
        "calibration_seed": str(seed),
    }
    description |= {SENSOR_BIASES: quantized.biases_to_json(), WEIGHTS: sha256(network.weights)}
    return host_model(quantized.core, description)
