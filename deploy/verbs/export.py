"""`export`: weights as a float ONNX file, or an INT8 file for another sensor."""

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from beers_deploy.model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_weights
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.target import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    InputPath,
    Interval,
    OutputFile,
    SensorLike,
    ShippedOrFile,
    TargetLike,
)
from beers_deploy.verbs.verb import refuse_with, refuse_without, verb

if TYPE_CHECKING:
    import onnx

    from beers_deploy.profiles.target import TargetProfile

logger = logging.getLogger(__name__)


@verb
def export(
    *,
    out: OutputFile,
    network: ShippedOrFile = VARIANT,
    sensor: SensorLike | None = None,
    tile: Annotated[int, Interval(ge=16, le=8192)] | None = None,
    board_file: OutputFile | None = None,
    target: TargetLike = DEFAULT_TARGET,
    delta: OutputFile | None = None,
    apply: InputPath | None = None,
) -> Path:
    """Write a network as an ONNX file, for any height and width unless a tile is given.

    Your own weights are checked against torch. Weights that are conditioned on a sensor, as all
    shipped ones are, become the network of one sensor: the middle of each range of its profile. A
    value outside the range of the training is replaced by its nearest end, with a warning.

    An INT8 file of such weights is conditioned on another sensor without a new calibration. `delta`
    writes what the sensor changes, and `apply` makes that sensor's file again, to the byte. For the
    exposures of 'restore', which stand for sensors of 2, 4 or 8 times the gain, NAME-x4.delta and
    so on are written too, as far as the sensor's noise allows.

    Args:
        out: ONNX file to write.
        network: a shipped name, also with -int8; weights (.safetensors); or an INT8 file that
            'quantize' made of weights of 'train --conditioned'.
        sensor: sensor of the network: a name, a .toml file, or blind; pleiades-degraded if none.
        tile: side in pixels of the one tile that the input is fixed to, such as 640 for a board.
        board_file: of an INT8 network: also write its core in the board's encoding, QDQ ONNX or an
            NPU's VINT8.
        target: board or NPU of `board_file`: a name, or a .toml file.
        delta: of an INT8 network: also write what the sensor changes in it, 1 to 3 kB.
        apply: of an INT8 network: condition it on the sensor of this delta, in place of `sensor`.

    Returns:
        The path of the ONNX file.

    Raises:
        ModelError: no such weights, or a sensor for weights that are for one sensor.
        OptionError: options that do not go together.
        ProfileError: no such sensor or board.
    """
    from beers_deploy.board_file import require_core_file
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.network_files import weights_file
    from beers_deploy.profiles.target import TargetProfile
    from beers_deploy.quant.onnx_file import require_onnx_name

    given = Path(network)
    if not (given.suffix or given.exists()):
        # This refuses names under which nothing is shipped.
        shipped_weights(given.name.removesuffix(INT8))
    path = weights_file(given)
    if board_file is None:
        refuse_without("`board_file`", target=target != DEFAULT_TARGET)
    if path.suffix != ".onnx":
        refuse_without(
            "an INT8 `network`",
            board_file=board_file is not None,
            delta=delta is not None,
            apply=apply is not None,
        )
    if apply is not None:
        refuse_with("`apply`", sensor=sensor is not None, delta=delta is not None)
    core = None if board_file is None else Path(board_file)
    deltas: dict[int, Path] = {}
    if delta is not None:
        deltas = _delta_files(Path(delta), sensor)
    inputs = [
        path,
        *(Path(each) for each in (apply, sensor) if isinstance(each, str | os.PathLike)),
    ]
    require_writable(Path(out), core, *deltas.values(), inputs=inputs)
    require_onnx_name(Path(out), core)
    board = TargetProfile.load(target)
    require_core_file(board, core, tile, inputs)
    if path.suffix != ".onnx":
        _export_float(path, Path(out), sensor, tile)
        return Path(out)
    model = _conditioned(path, sensor, None if apply is None else Path(apply))
    _export_int8(model, Path(out), tile, core, board)
    for factor, file in deltas.items():
        _save_delta(model, sensor or SENSOR, factor, file)
    return Path(out)


def _export_float(path: Path, out: Path, sensor: SensorLike | None, tile: int | None) -> None:
    """Write weights as float ONNX, your own after a comparison with torch."""
    from beers_deploy.float_onnx import about, float_for, to_onnx
    from beers_deploy.model.io.tensors import is_conditioned, read_conditioned, read_plain
    from beers_deploy.network_files import warn_outside
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.quant.onnx_file import save_onnx

    profile = Sensor.load(sensor or SENSOR) if is_conditioned(path) else None
    if profile is not None:
        warn_outside(profile, read_conditioned(path).kernels)
        model = float_for(path, path.stem, profile, tile)
    elif sensor is not None:
        raise ModelError(
            f"{path} holds a network that is for one sensor. Leave `sensor` out, or give weights "
            "of 'train --conditioned'."
        )
    else:
        weights = read_plain(path)
        model = to_onnx(weights, about(path.stem, weights.recipe), tile)
    if path.parent == SHIPPED:
        save_onnx(model, out)
        logger.info("wrote %s", out)
        return
    # It loads torch, which shipped networks do without.
    from beers_deploy.parity import require_parity, torch_network

    reference = torch_network(path, profile.nominal() if profile else None)
    difference = require_parity(reference, model, tile or 97)
    save_onnx(model, out)
    logger.info(
        "wrote %s: largest difference from torch %.2g of full scale (measured)", out, difference
    )


def _conditioned(path: Path, sensor: SensorLike | None, delta: Path | None) -> "onnx.ModelProto":
    """Return an INT8 network that is conditioned on a sensor, or on that of a delta."""
    from beers_deploy.network_files import int8_for_delta, int8_for_sensor, warn_outside
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.quant.onnx_file import load_onnx
    from beers_deploy.quant.sensor_bank.conditioned import required_conditioned_core

    model = load_onnx(path)
    if delta is not None:
        return int8_for_delta(model, delta)
    profile = Sensor.load(sensor or SENSOR)
    warn_outside(profile, required_conditioned_core(model).kernels)
    return int8_for_sensor(model, profile)


def _export_int8(
    model: "onnx.ModelProto",
    out: Path,
    tile: int | None,
    core_file: Path | None,
    target: "TargetProfile",
) -> None:
    """Write an INT8 network, and its core for a board where one is wanted."""
    from beers_deploy.board_file import save_core
    from beers_deploy.float_onnx import require_tile
    from beers_deploy.network import Network
    from beers_deploy.quant.encodings import host_model, read_core
    from beers_deploy.quant.onnx_file import fixed_tile_px, metadata, save_onnx

    core = read_core(model)
    side_px = tile or fixed_tile_px(model)
    require_tile(side_px, core.host_part.place_px)
    for_board = Network(model, out.stem).core(target, tile) if core_file else None
    save_onnx(host_model(core, metadata(model), side_px), out)
    logger.info("wrote %s", out)
    if for_board is not None and core_file is not None:
        save_core(for_board, core_file, target)


def _delta_files(delta: Path, sensor: SensorLike | None) -> dict[int, Path]:
    """Return the deltas to write by factor: the named one at 1, and one for each exposure."""
    from beers_deploy.model.exposure import factors_for
    from beers_deploy.profiles.sensor import Sensor

    factors = factors_for(Sensor.load(sensor or SENSOR).nominal())
    higher = {
        factor: delta.with_name(f"{delta.stem}-x{factor}{delta.suffix}")
        for factor in factors
        if factor > 1
    }
    return {1: delta, **higher}


def _save_delta(model: "onnx.ModelProto", sensor: SensorLike, factor: int, delta: Path) -> None:
    """Write the delta of an INT8 network that is conditioned on a sensor, at one exposure."""
    from beers_deploy.model.exposure import brightened
    from beers_deploy.model.io.files import whole_file
    from beers_deploy.network_files import int8_for_sensor
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.quant.sensor_bank.conditioned import delta_of_file

    profile = Sensor.load(sensor)
    exposed = model if factor == 1 else int8_for_sensor(model, brightened(profile, factor))
    packed = delta_of_file(exposed)
    with whole_file(delta) as temporary:
        temporary.write_bytes(packed)
    logger.info("wrote %s: %d bytes", delta, len(packed))
