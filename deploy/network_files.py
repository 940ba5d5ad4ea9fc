"""Resolve the name of a network on the command line, and condition a network on a sensor.

A shipped network is one set of weights, and one INT8 file, for every sensor in range. NAME is that
network in float32 and NAME-int8 in INT8. Each is conditioned on one sensor: its filters are
computed in milliseconds from the profile alone.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import onnx

from beers_deploy.float_onnx import float_for
from beers_deploy.model.bank import network_bank
from beers_deploy.model.departure import departure
from beers_deploy.model.family import sensor_vector
from beers_deploy.model.io.tensors import is_conditioned, read_conditioned
from beers_deploy.model.shipped import (
    INT8,
    SHIPPED,
    shipped_names,
    shipped_weights,
)
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND, BLIND_PROFILE
from beers_deploy.profiles.toml import unreadable
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.onnx_file import fixed_tile_px, load_onnx, metadata
from beers_deploy.quant.sensor_bank.conditioned import (
    SENSOR_BIASES,
    required_conditioned_core,
    with_delta,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Conditioned:
    """Weights of a network that is conditioned on its sensor, and the name that it is listed
    under.
    """

    name: str
    weights: Path

    @property
    def kernels(self) -> Kernels:
        """The kernels of its filter banks."""
        return read_conditioned(self.weights).kernels

    def model(self, sensor: Sensor, int8: bool) -> onnx.ModelProto:
        """Return the network for a sensor, in float32 or in INT8."""
        if not int8:
            return float_for(self.weights, self.name, sensor)
        shipped = SHIPPED / f"{self.name}{INT8}.onnx"
        if self.weights.parent != SHIPPED:
            raise ModelError(
                f"{self.weights} holds float weights, but an INT8 network is needed. Make one for "
                f"every sensor with 'beers-deploy quantize {self.weights} --out "
                f"{self.name}{INT8}.onnx'."
            )
        return int8_for_sensor(load_onnx(shipped), sensor)


def conditioned(path: Path) -> Conditioned | None:
    """Return the sensor-conditioned weights of a shipped name or a file.

    Returns:
        None if the path is neither the name of a shipped network nor a .safetensors file of
        sensor-conditioned weights.
    """
    if _is_shipped(path):
        name = path.name.removesuffix(INT8)
        return Conditioned(name, shipped_weights(name))
    return (
        Conditioned(path.stem, path)
        if path.suffix == ".safetensors" and is_conditioned(path)
        else None
    )


def weights_file(path: Path) -> Path:
    """Return the path of a file, or of the shipped network of that name. Nothing is read."""
    if not _is_shipped(path):
        return path
    return SHIPPED / f"{path.name}.onnx" if path.name.endswith(INT8) else shipped_weights(path.name)


def _is_shipped(path: Path) -> bool:
    """Return True if a path is the name of a shipped network, with or without the suffix for
    INT8.
    """
    # A file of that name goes before the shipped network.
    is_name = path == Path(path.name) and path.name.removesuffix(INT8) in shipped_names()
    return is_name and not path.exists()


def require_known(path: Path) -> Path:
    """Return the path of a network if it can be a file or a shipped name.

    A path with a suffix is returned without a check that the file exists.

    Raises:
        ModelError: the path has no suffix, does not exist, and is not the name of a shipped
            network.
    """
    if path.suffix or path.exists() or _is_shipped(path):
        return path
    raise ModelError(
        f"{path} is neither a file nor a shipped network ({', '.join(shipped_names())}, each also "
        f"with {INT8}). Correct the name or the path."
    )


def warn_outside(sensor: Sensor, kernels: Kernels) -> None:
    """Log a warning for each parameter of a sensor outside the range that a network was trained on.

    Args:
        sensor: the sensor, of which the middle of each range is used.
        kernels: the kernels of the network's banks.
    """
    instrument = sensor.nominal()
    for sentence in (*sensor_vector(instrument).outside, departure(instrument, kernels)):
        if sentence:
            logger.warning(sentence)


def other_sensor(model: onnx.ModelProto, sensor: Sensor) -> str:
    """Return a warning if a network was made for another sensor than the given one, else "".

    An unknown sensor contradicts no network.
    """
    if sensor.name == BLIND:
        return ""
    about = metadata(model)
    own = about.get("sensor", "")
    is_blind = own in ("", BLIND, BLIND_PROFILE)
    if is_blind and SENSOR_BIASES in about:
        return (
            f"look at the sensor: the INT8 file is that of an unknown sensor. For {sensor.name} "
            "condition it by 'beers-deploy export --network FILE --sensor SENSOR --out NEW', which "
            "restores better"
        )
    if is_blind or own == sensor.name:
        return ""
    return f"look at the sensor: the network was made for {own}, not for {sensor.name}"


def int8_for_sensor(
    model: onnx.ModelProto, sensor: Sensor, more: Mapping[str, str] | None = None
) -> onnx.ModelProto:
    """Return a conditioned INT8 network for another sensor: filters, unit and biases are replaced.

    Args:
        model: for any sensor.
        sensor: the sensor, of which the middle of each range is used.
        more: metadata to add.
    """
    stored = required_conditioned_core(model)
    instrument = sensor.nominal()
    core = stored.for_sensor(
        network_bank(instrument, stored.kernels), sensor_vector(instrument).values
    )
    return host_model(
        core, {**metadata(model), "sensor": sensor.name, **(more or {})}, fixed_tile_px(model)
    )


def int8_for_delta(model: onnx.ModelProto, delta: Path) -> onnx.ModelProto:
    """Return a conditioned INT8 network for the sensor of a delta, a file written by `export
    --delta`.
    """
    try:
        packed = delta.read_bytes()
    except OSError as error:
        raise ModelError(
            f"The delta {delta} cannot be read: {unreadable(delta) or error}. Give a file that "
            "'export --delta' wrote."
        ) from error
    core, name = with_delta(required_conditioned_core(model).core, packed, str(delta))
    return host_model(core, {**metadata(model), "sensor": name}, fixed_tile_px(model))
