"""Write networks as ONNX files: weights in float32, and INT8 files for another sensor."""

import hashlib
import logging
from pathlib import Path

import onnx

from beers_deploy import __version__
from beers_deploy.float_onnx import about, float_for, require_tile, to_onnx
from beers_deploy.kit.board_file import save_core
from beers_deploy.model.exposure import UNCHANGED, Exposure, exposures_for
from beers_deploy.model.io.files import whole_file, write_text
from beers_deploy.model.io.tensors import is_conditioned, read_conditioned, read_plain
from beers_deploy.model.shipped import SENSOR, SHIPPED
from beers_deploy.network import Network
from beers_deploy.network_files import int8_for_sensor, warn_outside
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.user_files.whole import read_whole, unreadable
from beers_deploy.quant.c_code import c_program
from beers_deploy.quant.encodings import (
    host_model,
    read_core,
    require_undamaged,
    required_tile,
    with_damage_of,
)
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import load_onnx, metadata, save_onnx
from beers_deploy.quant.sensor_bank.conditioned import (
    conditioned_core,
    delta_of_file,
    required_conditioned_core,
    with_delta,
)
from beers_deploy.quant.untrusted import FILE_BYTES

logger = logging.getLogger(__name__)


def export_float(path: Path, out: Path, sensor: SensorLike | None, tile: int | None) -> None:
    """Write trained weights as a float32 ONNX file.

    Weights that are not shipped are first compared with torch on a random image.

    Args:
        path: the .safetensors file of the weights.
        out: the ONNX file to write.
        sensor: the sensor to condition the network on, if its weights serve every sensor;
            pleiades-degraded if None. Weights of one sensor must have None.
        tile: side in pixels of the only image size that the network accepts; None for any size.

    Raises:
        ModelError: a sensor is given for weights of one sensor, or the ONNX file would compute
            other values than torch.
        OptionError: the network cannot move the pixels of such a tile into channels.
    """
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
        model = to_onnx(weights, about(path.stem, weights), tile)
    if path.parent == SHIPPED:
        save_onnx(model, out)
        logger.info("wrote %s", out)
        return
    # This loads torch, which shipped networks do not need.
    from beers_deploy.parity import require_parity, torch_network

    reference = torch_network(path, profile.nominal() if profile else None)
    difference = require_parity(reference, model, tile or 97)
    save_onnx(model, out)
    logger.info(
        "wrote %s: largest difference from torch %.2g of full scale (measured)", out, difference
    )


def conditioned_int8(path: Path, sensor: SensorLike | None, delta: Path | None) -> onnx.ModelProto:
    """Read an INT8 file, and condition it on another sensor if it serves every sensor.

    Args:
        path: the INT8 file, which `quantize` made.
        sensor: the new sensor; None for the default, or to read the file of one sensor as it is.
            It is ignored if there is a delta.
        delta: a file written by `export --delta` with the filters and biases of its sensor, to use
            in place of `sensor`; None for none.

    Returns:
        The ONNX model for the new sensor.

    Raises:
        ModelError: the INT8 file cannot be conditioned on a sensor, or the delta is damaged or
            belongs to another network.
    """
    model = load_onnx(path)
    if delta is not None:
        try:
            packed = read_whole(delta, FILE_BYTES)
        except (OSError, ValueError) as error:
            raise ModelError(
                f"The delta {delta} cannot be read: {unreadable(delta) or error}. Give a file that "
                "'export --delta' wrote."
            ) from error
        core, name = with_delta(required_conditioned_core(model).core, packed, str(delta))
        description = {**metadata(model), "sensor": name}
        return with_damage_of(model, host_model(core, description, fixed_tile_px(model)))
    if sensor is None and conditioned_core(model) is None:
        return model
    profile = Sensor.load(sensor or SENSOR)
    warn_outside(profile, required_conditioned_core(model).kernels)
    return int8_for_sensor(model, profile)


def export_int8(
    model: onnx.ModelProto,
    out: Path,
    tile: int | None,
    core_file: Path | None,
    target: TargetProfile,
    c_file: Path | None,
) -> None:
    """Write an INT8 network for onnxruntime, and on request its integer core for a board or as C.

    The integer core is the part that a DPU computes, without the encoding of pixels as int8 and the
    decoding of the result.

    Args:
        model: the INT8 network.
        out: the ONNX file for onnxruntime.
        tile: side in pixels of the only image size that the files accept; None for the size that
            `model` is fixed to, or any.
        core_file: the ONNX file of the core in the board's encoding; None to write none.
        target: the board.
        c_file: the C99 program of the core; None to write none.

    Raises:
        ModelError: `quantize` did not make the network, it is damaged, or sums in C would exceed
            int32.
        OptionError: the tile does not suit the network, or a C file or an NPU needs one.
    """
    require_undamaged(model, "the network")
    core = read_core(model)
    side_px = tile or fixed_tile_px(model)
    side_px = require_tile(side_px, core.host_part.place_px)
    # Also without a file for the board, because it refuses a tile that the layers do not fit.
    for_board = Network(model, out.stem).core(target, tile) if core_file or tile else None
    host = host_model(core, metadata(model), side_px)
    if c_file is not None:
        digest = hashlib.sha256(host.SerializeToString()).hexdigest()
        title = f"{out.name}, SHA-256 {digest}, as C by beers-deploy {__version__}"
        text = c_program(core, required_tile(side_px, "a C file, whose buffers are static"), title)
        write_text(c_file, text)
        logger.info("wrote %s: the same integers in C99", c_file)
    save_onnx(host, out)
    logger.info("wrote %s", out)
    if for_board is not None and core_file is not None:
        save_core(for_board, core_file, target)


def delta_files(delta: Path, sensor: SensorLike) -> dict[Exposure, Path]:
    """Name the delta files of a sensor, which hold the filters and biases that suit it.

    `restore` multiplies dark pixels and strong edges by an exposure factor, and each factor needs
    biases of its own.

    Args:
        delta: the file for the factor 1. The other names add the factor, such as NAME-x4.delta.
        sensor: the sensor, whose noise decides which factors can be used.

    Returns:
        The path of each delta, by its exposure.
    """
    files = {UNCHANGED: delta}
    for exposure in exposures_for(Sensor.load(sensor).nominal(), int8=True):
        if exposure != UNCHANGED:
            name = f"{delta.stem}-x{exposure.factor:g}{delta.suffix}"
            files[exposure] = delta.with_name(name)
    return files


def save_delta(model: onnx.ModelProto, sensor: SensorLike, exposure: Exposure, delta: Path) -> None:
    """Write the delta of an INT8 network: the filters, biases and factor that suit one sensor.

    Args:
        model: the INT8 network, conditioned on `sensor`.
        sensor: the sensor.
        exposure: the factor by which pixels are multiplied before the network.
        delta: the file to write.

    Raises:
        ModelError: the network cannot be conditioned on a sensor.
    """
    if exposure != UNCHANGED:
        model = int8_for_sensor(model, Sensor.load(sensor), exposure)
    packed = delta_of_file(model)
    with whole_file(delta) as temporary:
        temporary.write_bytes(packed)
    logger.info("wrote %s: %d bytes", delta, len(packed))
