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
from beers_deploy.quant.encodings import SENSOR_BIASES, host_model, read_core
from beers_deploy.quant.gate import GateResult, compare, gate_row
from beers_deploy.quant.integer.agreement import integer_rows
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
from beers_deploy.quant.sensor_bank.conditioned import WEIGHTS, required_conditioned_core
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
    """Parse the option `finetune` of `quantize`.

    Args:
        finetune: "auto", or the number of training steps as an int or as digits.

    Returns:
        The number of steps; None for "auto", which continues while it helps.

    Raises:
        OptionError: the value is neither.
    """
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
    """Quantise a float network of any kind; the work of `quantize`.

    Sensor-conditioned weights, from which the network of any sensor can be computed, are calibrated
    on simulated patches of many sensors at once. Any other network is calibrated on its data.

    Args:
        network: a float network, a shipped name, or a file of sensor-conditioned weights.
        data: the data that the network is calibrated on.
        target: the board whose rules apply.
        finetune: the number of training steps of the integers, or "auto" to continue while they
            help.
        effort: the effort of the search for equalisation factors.
        adapts: True to replace operators that the DPU lacks by ones that it has.
        output: name of the output to retain; None if the network has only one.

    Returns:
        The INT8 network, whose `origin` is the float network, and the samples held out from
        calibration. There are none (None) for sensor-conditioned weights.

    Raises:
        ModelError: the network is INT8 already, or has an operation that the DPU does not compute.
        OptionError: samples, fine-tuning or `adapts` are given for sensor-conditioned weights, or
            the target has neither a DPU nor an NPU.
        ImageError: the network does not accept the samples.
        MissingExtraError: torch is not installed, and fine-tuning needs it.
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
    if origin.weights and not weights:
        raise OptionError(
            f"{origin.label} is computed for one sensor already, but it is calibrated over the "
            f"whole family of sensors. Give {origin.weights.name!r} or its file, and `sensor`."
        )
    with faults_named(origin.label):
        if weights:
            # One calibration serves all sensors of the trained range. The patches of one sensor
            # give the statistics of each layer.
            images = [] if data.images is None else [data.images]
            family = family_model(weights, images, data.seed, _shifts_of(target), effort=effort)
            host = int8_for_sensor(family, data.sensor, more={"target": target.name})
            degraded = data.simulated.drawn.degraded
            layers = integer_rows(origin.model, read_core(host), host, degraded)
            return Network(host, f"{weights.name}-int8", origin=origin, layers=layers), None
        # Samples in memory may be given one after the other, so they are read only here.
        source = data.own(origin) or data.simulated
        return quantize_alone(origin, source, target, steps, effort, adapts), source.unseen


def quantize_alone(
    origin: Network,
    calibration: Source,
    target: TargetProfile,
    steps: int | None,
    effort: Effort,
    adapts: bool,
) -> Network:
    """Quantise a network that is not conditioned on a sensor, or for its present sensor only.

    Args:
        origin: the float network.
        calibration: the simulated patches or user's samples from which scales are chosen.
        target: the board whose rules apply.
        steps: the number of training steps of the integers; None to continue while they help, 0
            for none.
        effort: the effort of the search for equalisation factors.
        adapts: True to replace operators that the DPU lacks by ones that it has. The statistics
            still compare the result with the unchanged `origin`.

    Returns:
        The INT8 network, whose `layers` have statistics of each layer.

    Raises:
        ModelError: the DPU does not compute an operation.
        OptionError: the target has neither a DPU nor an NPU.
        MissingExtraError: torch is not installed, and `steps` is not 0.
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
        # Simulated patches already reach from dark ground to full scale.
        own = isinstance(calibration, OwnSamples)
        result = quantize_model(
            adapted.model,
            calibration.drawn,
            about,
            shifts,
            tuning,
            effort=effort,
            brightens=own,
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


def _shifts_of(target: TargetProfile) -> Shifts:
    if not (target.configurations or target.npu):
        raise OptionError(
            f"`target` must have a DPU or NPU, but {target.name!r} has none. Choose one of "
            f"{', '.join(board_names() + npu_names())}."
        )
    return target_shifts(target)


def differences_of(network: Network, held_out: "Patches") -> GateResult:
    """Measure the differences between an INT8 network and its float network.

    Args:
        network: the INT8 network that `quantized` returned, which knows its float network.
        held_out: the samples held out from calibration.
    """
    assert network.origin is not None  # noqa: S101
    return compare(open_any_size(network.origin.model), open_any_size(network.model), held_out)


def sensitivity_report(
    network: Network, held_out: "Patches", differences: GateResult, prices: Sequence[Row]
) -> tuple[list[Row], Report]:
    """Analyse which layers and samples cause the INT8 error, as rows and as an HTML page.

    Args:
        network: the INT8 network that `quantize_alone` returned.
        held_out: the samples held out from calibration.
        differences: the differences measured on these samples.
        prices: the rows of `price_rows`, the loss that each restriction of the DPU's integers adds,
            which the page shows as well.

    Returns:
        The rows (the differences, the error of each layer, the worst samples, the sizes of the
        differences), and the content of the page.
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
    """Read the step sizes by which an INT8 file rounds the results of its layers.

    `train` calls this to imitate INT8 while it trains a sensor-conditioned network further.

    Args:
        int8: the INT8 file.
        weights: the .safetensors file that it was quantised from.

    Returns:
        The step size of each channel of the tensors between the layers, as torch tensors.

    Raises:
        ModelError: the INT8 file was quantised from other weights, or is not conditioned on a
            sensor.
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
    images: Sequence[Path],
    seed: int = 0,
    shifts: Shifts = SHIFTS,
    effort: Effort = Effort.normal,
    passes: Passes = ALL,
) -> onnx.ModelProto:
    """Quantise a sensor-conditioned network with one calibration for the whole family of sensors.

    The family is the range of blurs and noises that such networks are trained on.

    Args:
        network: sensor-conditioned weights, as 'train --conditioned' writes them.
        images: folders of photographs, to which about the same number of drawn scenes is added. If
            empty, only scenes drawn at random are used.
        seed: the seed of the patches.
        shifts: the bit shifts that the target's arithmetic allows.
        effort: the effort of the search for equalisation factors.
        passes: the passes that reduce the rounding error; by default all of them. The ablation
            leaves out one at a time.

    Returns:
        The ONNX model for the sensor in the middle of the family. `int8_for_sensor` makes that of
        another sensor from it.
    """
    # This loads SciPy, which a user's own samples do not need.
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
