"""A float network quantised: what `quantize` makes of it, layer by layer in whole numbers, and
where INT8 errs.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import onnx

from beers_deploy.dpu.board import BoardLike
from beers_deploy.model.bank import bank_of_vector
from beers_deploy.model.family import RANGES
from beers_deploy.model.io.files import sha256
from beers_deploy.model.io.tensors import read_conditioned
from beers_deploy.model.progress import Progress, reporting
from beers_deploy.model.progress import progress as begun
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.network_files import Conditioned, conditioned, told_int8
from beers_deploy.profiles.errors import ModelError, OptionError, optional
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import REFERENCE, load_sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, TargetProfile, board_names, npu_names
from beers_deploy.quant.banked.family import FAMILY, WEIGHTS, required_family
from beers_deploy.quant.core import SHIFTS, Shifts, target_shifts
from beers_deploy.quant.encodings import host_model, read_core
from beers_deploy.quant.gate import compare, gate_row
from beers_deploy.quant.integer.reference import integer_rows
from beers_deploy.quant.onnx_file import faults_named, load_onnx, metadata, require_quantised
from beers_deploy.quant.passes.selection import Passes
from beers_deploy.quant.quantise import quantise_model
from beers_deploy.quant.samples import OwnSamples, samples_of
from beers_deploy.quant.sensitivity import (
    WORST,
    headline,
    layer_error_rows,
    losses,
    sizes_row,
    spread_of,
    worst_row,
)
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.untrusted import contradictions
from beers_deploy.report.page import Report
from beers_deploy.report.sensitivity_page import sensitivity_page

if TYPE_CHECKING:
    from beers_deploy.model.convbeers import Rounding
    from beers_deploy.quant.calibration import Calibration

Source: TypeAlias = "Calibration | OwnSamples"
"""Where patches come from: simulated ones, or a user's own."""


def quantize(
    network: NetworkLike,
    samples: object = None,
    *,
    board: BoardLike = DEFAULT_TARGET,
    sensor: SensorLike = SENSOR,
    images: str | os.PathLike[str] | None = None,
    patches: int = 64,
    patch_px: int = 128,
    finetune: int | str = 0,
    seed: int = 0,
    progress: Progress = None,
) -> Network:
    """Quantise a float network to static INT8.

    Args:
        network: the float network. A shipped name, or weights that `train --conditioned` wrote, are
            calibrated over the whole family of sensors and told `sensor`.
        samples: what it is calibrated on: a file, a folder, a batch (N, C, H, W) in [0, 1], two
            batches (images, references), or an iterable of these such as a DataLoader; None
            simulates patches.
        board: whose rules to obey.
        sensor: of the simulated patches.
        images: folder of scenes for the simulated patches; None for drawn ones.
        patches: how many are simulated.
        patch_px: their side.
        finetune: for how many steps the whole numbers are trained; "auto" trains until held-out
            pairs err no less.
        seed: of the patches.
        progress: a function that is told each step, False for silence, None for a bar or lines on
            standard error.

    Returns:
        The INT8 network: `origin` is the float one, `layers` says how wide each layer's sums are
            and what saturates.

    Raises:
        ModelError: an operation that the DPU does not compute, or weights of no sensible size.
        OptionError: a board without a DPU or NPU, samples that the network needs, or options that
            do not go together.
        ImageError: samples that the network does not take.
        ProfileError: no such board or sensor.

    Examples:
        >>> import torch
        >>> network = torch.nn.Conv2d(1, 1, 3, padding=1)
        >>> samples = np.random.default_rng(0).random((8, 1, 32, 32), np.float32)
        >>> network = bd.Network.load(network, example=(1, 1, 32, 32))
        >>> bd.quantize(network, samples, board="zcu102").precision
        'int8'
    """
    target = TargetProfile.load(board)
    profile = Sensor.load(sensor)
    banked = conditioned(Path(network)) if isinstance(network, str | os.PathLike) else None
    steps = steps_of(finetune)
    if banked and (steps != 0 or samples is not None):
        remedy = (
            "leave it out: such a network is calibrated over the whole family of sensors at once"
        )
        expected = "no samples or fine-tuning"
        raise OptionError("a network behind a bank", expected=expected, got="one", remedy=remedy)
    origin = Network.load(network, sensor=profile)
    require_quantised(origin.model, origin.label, wanted=False)
    scenes = None if images is None else Path(images)
    with reporting(progress), faults_named(origin.label):
        own = samples_of(origin.model, samples)
        if banked:
            simulated = _simulated(profile, scenes, patches, patch_px, seed)
            return replace(_banked(banked, simulated, profile, target), origin=origin)
        calibration: Source = own or _simulated(profile, scenes, patches, patch_px, seed)
        result = _by_itself(origin, calibration, target, steps)
    return replace(result, origin=origin)


def steps_of(finetune: int | str) -> int | None:
    """Steps of fine-tuning, None for "auto"."""
    if finetune == "auto":
        return None
    if not str(finetune).isdecimal():
        expected = "auto, or whole steps from 0"
        remedy = "choose auto"
        raise OptionError("finetune", expected=expected, got=repr(finetune), remedy=remedy)
    return int(finetune)


def _simulated(
    sensor: Sensor, images: Path | None, patches: int, patch_px: int, seed: int
) -> "Calibration":
    # This loads SciPy, which samples of one's own do without.
    from beers_deploy.quant.calibration import Calibration

    return Calibration(sensor, images, patches, patch_px, seed)


def _by_itself(
    origin: Network, calibration: Source, target: TargetProfile, steps: int | None
) -> Network:
    shifts = _shifts_of(target)
    tuning = None
    if steps != 0:
        optional("torch", "finetune")
        from beers_deploy.quant.passes.tune import Tuning

        tuning = Tuning(calibration.for_tuning.pairs, steps)
    with begun("calibrating") as step:
        about = {**calibration.about, "target": target.name}
        result = quantise_model(origin.model, calibration.drawn, about, shifts, tuning, log=step)
    layers = integer_rows(origin.model, result.core, result.host, calibration.drawn.degraded)
    return Network(result.host, f"{origin.name}-int8", layers=layers, quantised=result)


def _banked(
    network: Conditioned, calibration: "Calibration", sensor: Sensor, target: TargetProfile
) -> Network:
    """A network behind a bank, told a sensor; each integer layer on its patches."""
    images = [] if calibration.images is None else [calibration.images]
    family = family_model(network, images, calibration.seed, _shifts_of(target))
    host = told_int8(family, sensor, {"target": target.name})
    floating = network.model(sensor, int8=False)
    layers = integer_rows(floating, read_core(host), host, calibration.drawn.degraded)
    return Network(host, f"{network.name}-int8", layers=layers)


def _shifts_of(target: TargetProfile) -> Shifts:
    if not (target.configurations or target.npu):
        expected = f"a target with a DPU or NPU: {', '.join(board_names() + npu_names())}"
        remedy = "choose another"
        raise OptionError("target", expected=expected, got=repr(target.name), remedy=remedy)
    return target_shifts(target)


def losses_of(network: Network, samples: object = None, **drawn: Any) -> str:
    """What INT8 costs on what calibration did not see, in one sentence; all as in
    `sensitivity_report`.
    """
    assert network.origin is not None and network.quantised is not None  # noqa: S101, PT018
    model = network.origin.model
    result = network.quantised
    held_out = (samples_of(model, samples) or _simulated(**drawn)).unseen
    differences = compare(
        open_any_size(model), open_any_size(result.host), held_out.pairs, samples is None
    )
    return losses(result, differences, held_out)


def sensitivity_report(
    network: Network, samples: object = None, more: Sequence[Row] = (), **drawn: Any
) -> tuple[list[Row], Report]:
    """Where INT8 errs on patches or samples that calibration did not see: the rows, and a page.

    Args:
        network: what `quantize` made.
        samples: as given there.
        more: rows that the page shows behind.
        drawn: sensor, images, patches, patch_px and seed as given there.
    """
    assert network.origin is not None and network.quantised is not None  # noqa: S101, PT018
    model = network.origin.model
    result = network.quantised
    held_out = (samples_of(model, samples) or _simulated(**drawn)).unseen
    sessions = open_any_size(model), open_any_size(result.host)
    differences = compare(*sessions, held_out.pairs, samples is None)
    spread = spread_of(*sessions, held_out.degraded)
    worst = spread.worst(WORST)
    layers = layer_error_rows(result, held_out)
    rows = [
        gate_row(differences),
        *layers,
        *(worst_row(k, held_out, spread) for k in worst),
        sizes_row(spread),
    ]
    return rows, sensitivity_page(
        headline(differences, layers), [*rows, *more], spread, held_out, sessions, worst
    )


def rounding_of(int8: Path, weights: Path) -> "Rounding":
    """How the INT8 file of a network behind a bank rounds its maps; refused where it is of other
    weights.
    """
    import torch

    from beers_deploy.model.convbeers import Rounding
    from beers_deploy.quant.banked.calibrate import map_steps

    model = load_onnx(int8)
    tensors = read_conditioned(weights)
    if metadata(model).get(WEIGHTS) != sha256(weights):
        expected = f"the INT8 file of {weights}"
        remedy = "make it with 'beers-deploy quantize'"
        raise ModelError(str(int8), expected=expected, got="another network's", remedy=remedy)
    with contradictions(str(int8)):
        step_sizes = map_steps(required_family(model), tensors)
    stream, *inner = (torch.from_numpy(np.float32(steps))[:, None, None] for steps in step_sizes)
    return Rounding(stream, tuple(inner))


def family_model(
    network: Conditioned,
    images: Sequence[Path] = (),
    seed: int = 0,
    shifts: Shifts = SHIFTS,
    passes: Passes | None = None,
) -> onnx.ModelProto:
    """The INT8 file of a network behind a bank, for the middle of the family; any sensor can be
    told to it.

    Args:
        network: of weights that 'train --conditioned' wrote.
        images: folders of photographs, beside which about as many drawn scenes are seen; none takes
            these alone.
        seed: of the patches.
        shifts: the windows of the target.
        passes: that reduce the error; None for those that pay behind a bank.
    """
    # This loads SciPy, which samples of one's own do without.
    from beers_deploy.model.simulator.procedural import load_scenes
    from beers_deploy.quant.banked.calibrate import PASSES, family_images, quantise_family

    weights = read_conditioned(network.weights)
    aim = load_sensor(REFERENCE).nominal()
    scale = weights.variant.scale
    scenes = load_scenes(None, aim, seed)
    # Drawn scenes have stronger edges, photographs finer ground, so both are calibrated on.
    if images:
        photographs = list(chain.from_iterable(load_scenes(folder, aim, seed) for folder in images))
        scenes = photographs + scenes * max(len(photographs) // len(scenes), 1)
    with begun(f"calibrating {network.name} over the family of sensors") as log:
        family_patches = family_images(scenes, scale, seed, weights.kernels)
        middle = bank_of_vector((0.0,) * len(RANGES), weights.kernels)
        family = quantise_family(weights, middle, family_patches, shifts, passes or PASSES, log)
    description = {
        "variant": network.name,
        "reference": REFERENCE,
        "precision": "int8 legal",
        "calibration_seed": str(seed),
    }
    description |= {FAMILY: family.to_words(), WEIGHTS: sha256(network.weights)}
    return host_model(family.core, description)
