"""`export`: weights as a float ONNX file, or an INT8 file for another sensor."""

import os
from functools import partial
from pathlib import Path
from typing import Annotated

from beers_deploy.model.shipped import INT8, SENSOR, VARIANT, shipped_weights
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    InputPath,
    Interval,
    OutputFile,
    SensorLike,
    ShippedOrFile,
    TargetLike,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb


@verb
def export(
    *,
    out: OutputFile,
    network: ShippedOrFile = VARIANT,
    sensor: SensorLike | None = None,
    tile: Annotated[int, Interval(ge=16, le=8192)] | None = None,
    board_file: OutputFile | None = None,
    c: OutputFile | None = None,
    target: TargetLike = DEFAULT_TARGET,
    delta: OutputFile | None = None,
    apply: InputPath | None = None,
) -> Path:
    """Write a network as an ONNX file, for any height and width unless a tile is given.

    Weights that are conditioned on a sensor, as all shipped ones are, become the network of one
    sensor: the middle of each range of its profile, or the nearest limit of the trained range, with
    a warning. An INT8 file of such weights needs no new calibration for another sensor.

    Args:
        out: ONNX file to write.
        network: a shipped name, also with -int8; weights (.safetensors); or an INT8 file that
            'quantize' made.
        sensor: sensor of the network: name, .toml file or blind; pleiades-degraded by default.
        tile: side in pixels of the one tile that the input is fixed to, such as 640.
        board_file: also write the core of an INT8 network in the board's encoding: QDQ ONNX, of an
            NPU VINT8.
        c: also write the core of an INT8 network as a C99 file for one tile, with integers only.
        target: board or NPU of `board_file`: name or .toml file.
        delta: also write the sensor's changes to an INT8 network, 1 to 3 kB; and NAME-x4.delta and
            so on for the exposures of 'restore', as far as the noise allows.
        apply: apply this delta to the INT8 network, instead of `sensor`. The result is the file of
            that sensor, byte for byte.

    Returns:
        The path of the ONNX file.

    Raises:
        ModelError: no such weights, or a sensor for weights that are for one sensor.
        OptionError: options that do not go together.
        ProfileError: no such sensor or board.
    """
    options = partial(changed, export, locals())

    from beers_deploy.kit.board_file import require_core_file
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.network_files import weights_file
    from beers_deploy.onnx_export import (
        conditioned_int8,
        delta_files,
        export_float,
        export_int8,
        save_delta,
    )
    from beers_deploy.profiles.target import TargetProfile
    from beers_deploy.quant.onnx_file import require_onnx_name

    source = Path(network)
    if not (source.suffix or source.exists()):
        # This refuses names under which nothing is shipped.
        shipped_weights(source.name.removesuffix(INT8))
    path = weights_file(source)
    if board_file is None:
        refuse_without("`board_file`", **options("target"))
    if path.suffix != ".onnx":
        refuse_without("an INT8 `network`", **options("board_file", "c", "delta", "apply"))
    if apply is not None:
        refuse_with("`apply`", **options("sensor", "delta"))
    core, c_file = (path_or_none(file) for file in (board_file, c))
    deltas = {} if delta is None else delta_files(Path(delta), sensor or SENSOR)
    inputs = [
        path,
        *(Path(each) for each in (apply, sensor) if isinstance(each, str | os.PathLike)),
    ]
    require_writable(Path(out), core, c_file, *deltas.values(), inputs=inputs)
    require_onnx_name(Path(out), core)
    board = TargetProfile.load(target)
    require_core_file(board, core, tile, inputs)
    if path.suffix != ".onnx":
        export_float(path, Path(out), sensor, tile)
        return Path(out)
    model = conditioned_int8(path, sensor, path_or_none(apply))
    export_int8(model, Path(out), tile, core, board, c_file)
    for exposure, file in deltas.items():
        save_delta(model, sensor or SENSOR, exposure, file)
    return Path(out)
