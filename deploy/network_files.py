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
from beers_deploy.model.exposure import UNCHANGED, Exposure, brightened
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
from beers_deploy.quant.encodings import host_model, with_damage_of
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.quant.sensor_bank.conditioned import required_conditioned_core

logger = logging.getLogger(__name__)

UNKNOWN_SENSORS = ("", BLIND, BLIND_PROFILE)
"""The names of a sensor, in a file's metadata, that stand for none in particular."""


@dataclass(frozen=True)
class Conditioned:
    """A weights file from which the network of any sensor can be computed.

    Such a network is conditioned on its sensor: the filters of its first layer, its filter bank,
    are computed from the sensor's blur and noise, and the trained weights behind them stay.

    Attributes:
        name: the name of the shipped network, or the stem of the file.
        weights: the .safetensors file.
    """

    name: str
    weights: Path

    @property
    def kernels(self) -> Kernels:
        """The method by which the filters of the first layer are reduced to 7 x 7 pixels."""
        return read_conditioned(self.weights).kernels

    def model(self, sensor: Sensor, int8: bool, exposure: Exposure = UNCHANGED) -> onnx.ModelProto:
        """Compute the ONNX model for a sensor.

        Args:
            sensor: the sensor, of which the middle of each range is used.
            int8: True for INT8, False for float32.
            exposure: the factor by which pixels are multiplied before the network.

        Raises:
            ModelError: INT8 is requested for weights that are not shipped. Only a shipped network
                has a known INT8 file.
        """
        if not int8:
            return float_for(self.weights, self.name, brightened(sensor, exposure.gain))
        if self.weights.parent != SHIPPED:
            raise ModelError(
                f"{self.weights} holds float weights, but an INT8 network is needed. Make one for "
                f"every sensor with 'beers-deploy quantize {self.weights} --out "
                f"{self.name}{INT8}.onnx'."
            )
        shipped = load_onnx(SHIPPED / f"{self.name}{INT8}.onnx")
        return int8_for_sensor(shipped, sensor, exposure)


@dataclass(frozen=True)
class ConditionedFile:
    """An INT8 file from which the network of any sensor can be computed.

    It does for a user's INT8 file what `network_files.Conditioned` does for weights.

    Attributes:
        name: the name of the networks computed from it.
        stored: the model in the file.
    """

    name: str
    stored: onnx.ModelProto

    @property
    def kernels(self) -> Kernels:
        """The method by which the filters of the first layer are reduced to 7 x 7 pixels."""
        return required_conditioned_core(self.stored).kernels

    def model(
        self,
        sensor: Sensor,
        int8: bool,  # noqa: ARG002 - always INT8
        exposure: Exposure = UNCHANGED,
    ) -> onnx.ModelProto:
        """Compute the INT8 model for a sensor, of which the middle of each range is used."""
        return int8_for_sensor(self.stored, sensor, exposure)


def conditioned(path: Path) -> Conditioned | None:
    """Find the sensor-conditioned weights that a shipped name or a file stands for.

    Args:
        path: the name of a shipped network, with or without the suffix -int8, or a file.

    Returns:
        The weights; None if the path is neither the name of a shipped network nor a .safetensors
        file of sensor-conditioned weights.
    """
    if _is_shipped(path):
        name = path.name.removesuffix(INT8)
        return Conditioned(name, shipped_weights(name))
    if path.suffix == ".safetensors" and is_conditioned(path):
        return Conditioned(path.stem, path)
    return None


def weights_file(path: Path) -> Path:
    """Resolve a name to the file that would be read, for a check that it is not overwritten.

    Args:
        path: a file, or the name of a shipped network.

    Returns:
        The shipped .onnx (INT8) or .safetensors (float32) file for a shipped name, and any other
        path unchanged. No file is opened.
    """
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
    """Refuse a word that can be neither the file of a network nor the name of a shipped one.

    Args:
        path: the word of the user. With a suffix it passes, whether or not the file exists.

    Returns:
        The same path.

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
    """Log a warning for each parameter of a sensor outside the range that networks were trained on.

    A further warning names an MTF whose curve over the frequencies is another than those that the
    networks were trained on.

    Args:
        sensor: the sensor, of which the middle of each range is used.
        kernels: the method by which the network's filters are reduced to 7 x 7 pixels.
    """
    instrument = sensor.nominal()
    for sentence in (*sensor_vector(instrument).outside, departure(instrument, kernels)):
        if sentence:
            logger.warning(sentence)


def other_sensor(model: onnx.ModelProto, sensor: Sensor) -> str:
    """Compare a network's recorded sensor with the one that acquires the images.

    Args:
        model: the network, whose metadata may name a sensor.
        sensor: the sensor of the images. The profile of an unknown sensor contradicts no network.

    Returns:
        A warning for the user if the network was made for another sensor; otherwise "".
    """
    own = metadata(model).get("sensor", "")
    if sensor.name == BLIND or own in (*UNKNOWN_SENSORS, sensor.name):
        return ""
    return f"look at the sensor: the network was made for {own}, not for {sensor.name}"


def int8_for_sensor(
    model: onnx.ModelProto,
    sensor: Sensor,
    exposure: Exposure = UNCHANGED,
    more: Mapping[str, str] | None = None,
) -> onnx.ModelProto:
    """Condition an INT8 network on another sensor.

    Only the filters of the first layer, the biases, and the factor from integers to pixel values
    are replaced; all other integers stay.

    Args:
        model: an INT8 network that `quantize` made from sensor-conditioned weights, for whichever
            sensor.
        sensor: the new sensor, of which the middle of each range is used.
        exposure: the factor by which pixels are multiplied before the network.
        more: metadata to write in addition to that of `model`.

    Returns:
        A new ONNX model, which accepts the same image sizes as `model`.

    Raises:
        ModelError: `model` cannot be conditioned on a sensor.
    """
    stored = required_conditioned_core(model)
    instrument = brightened(sensor, exposure.gain).nominal()
    core = stored.for_sensor(
        network_bank(instrument, stored.kernels),
        sensor_vector(instrument).values,
        exposure.finer,
        instrument.offset_dn / instrument.max_dn,
    )
    about = {**metadata(model), "sensor": sensor.name, **(more or {})}
    return with_damage_of(model, host_model(core, about, fixed_tile_px(model)))
