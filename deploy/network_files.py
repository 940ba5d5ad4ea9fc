"""What a command means by the name of a network, and a network for a sensor.

A shipped network is one set of weights, and one INT8 file, for every sensor in range. NAME is that
network in float32 and NAME-int8 in INT8, each conditioned on one sensor: its filters, written in
milliseconds from the profile alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import onnx

from beers_deploy.export import float_for
from beers_deploy.model.bank import network_bank
from beers_deploy.model.departure import departure
from beers_deploy.model.family import sensor_vector
from beers_deploy.model.io.tensors import is_conditioned, read_conditioned
from beers_deploy.model.progress import Log, no_log
from beers_deploy.model.shipped import (
    INT8,
    SHIPPED,
    VARIANT,
    shipped_names,
    shipped_weights,
)
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import BLIND, BLIND_PROFILE
from beers_deploy.profiles.toml import unreadable
from beers_deploy.quant.banked.family import required_family, with_delta
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.onnx_file import fixed_tile_px, load_onnx, metadata


@dataclass(frozen=True)
class Conditioned:
    """Weights of a network that is told its sensor, and the name that it is listed under."""

    name: str
    weights: Path

    @property
    def kernels(self) -> Kernels:
        """What the kernels of its banks are."""
        return read_conditioned(self.weights).kernels

    def model(self, sensor: Sensor, int8: bool) -> onnx.ModelProto:
        """The network told a sensor, in float32 or in INT8."""
        if not int8:
            return float_for(self.weights, self.name, sensor)
        shipped = SHIPPED / f"{self.name}{INT8}.onnx"
        if self.weights.parent != SHIPPED:
            remedy = (
                f"make one for every sensor: beers-deploy quantize {self.weights} --out "
                f"{self.name}{INT8}.onnx"
            )
            raise ModelError(
                str(self.weights), expected="an INT8 network", got="float weights", remedy=remedy
            )
        return told_int8(load_onnx(shipped), sensor)


def conditioned(given: Path | None) -> Conditioned | None:
    """The network to be told its sensor that is meant, None meaning the default one; None for any
    other file.
    """
    if given is None:
        return Conditioned(VARIANT, shipped_weights(VARIANT))
    if _is_shipped(given):
        name = given.name.removesuffix(INT8)
        return Conditioned(name, shipped_weights(name))
    return (
        Conditioned(given.stem, given)
        if given.suffix == ".safetensors" and is_conditioned(given)
        else None
    )


def weights_file(given: Path) -> Path:
    """The file given, or the shipped one of that name where no such file lies; nothing is read."""
    if not _is_shipped(given):
        return given
    return (
        SHIPPED / f"{given.name}.onnx" if given.name.endswith(INT8) else shipped_weights(given.name)
    )


def _is_shipped(path: Path) -> bool:
    """Whether a shipped network is meant by its name, with INT8 behind it or without."""
    # A file of that name goes before the shipped network.
    is_name = path == Path(path.name) and path.name.removesuffix(INT8) in shipped_names()
    return is_name and not path.exists()


def in_int8(given: Path) -> Path:
    """A shipped network's name with INT8 behind it; any other path as it is."""
    return Path(given.name.removesuffix(INT8) + INT8) if _is_shipped(given) else given


def pair_of(floating: Path | None, int8: Path | None) -> tuple[Path, Path]:
    """A float network and its INT8: the files given, or a shipped pair by its name, the default one
    if None.
    """
    name = Path(VARIANT) if floating is None else floating
    if int8 is None and not name.suffix and not name.exists():
        shipped_weights(name.name)
    elif int8 is None:
        remedy = "give its INT8 file too, or the name of a shipped pair"
        raise OptionError(
            "INT8", expected=f"the INT8 network of {name.name}", got="none", remedy=remedy
        )
    return name, in_int8(int8 or name)


def require_known(given: Path) -> Path:
    """Return a path that may be a file or a shipped name; refuse any other."""
    if given.suffix or given.exists() or _is_shipped(given):
        return given
    expected = f"a file, or a shipped network ({', '.join(shipped_names())}, each also with {INT8})"
    raise ModelError(
        str(given), expected=expected, got="neither", remedy="correct the name, or the path"
    )


def warn_outside(sensor: Sensor, kernels: Kernels, log: Log) -> None:
    """Tell what of a sensor lies outside of what a network was trained on, whose banks have these
    kernels.
    """
    instrument = sensor.nominal()
    for sentence in (*sensor_vector(instrument).outside, departure(instrument, kernels)):
        if sentence:
            log(f"warning: {sentence}")


def other_sensor(model: onnx.ModelProto, sensor: Sensor) -> str:
    """Return a warning if a network was made for another sensor than the one
    named; else nothing.
    """
    own = metadata(model).get("sensor", "")
    if own in ("", BLIND, BLIND_PROFILE, sensor.name):
        return ""
    return f"look at the sensor: the network was made for {own}, not for {sensor.name}"


def told_int8(
    model: onnx.ModelProto, sensor: Sensor, more: Mapping[str, str] | None = None, log: Log = no_log
) -> onnx.ModelProto:
    """An INT8 network behind a bank told another sensor: its filters, unit and biases written anew.

    Args:
        model: of whatever sensor.
        sensor: of which the middle is taken.
        more: metadata to add.
        log: is told what of the sensor lies outside the range that was trained.
    """
    family = required_family(model)
    warn_outside(sensor, family.kernels, log)
    instrument = sensor.nominal()
    core = family.for_sensor(
        network_bank(instrument, family.kernels), sensor_vector(instrument).values
    )
    return host_model(
        core, {**metadata(model), "sensor": sensor.name, **(more or {})}, fixed_tile_px(model)
    )


def told_by_delta(model: onnx.ModelProto, delta: Path) -> onnx.ModelProto:
    """An INT8 network behind a bank told the sensor of a delta, a file that
    `export --delta` wrote.
    """
    try:
        packed = delta.read_bytes()
    except OSError as error:
        got = unreadable(delta) or str(error)
        remedy = "give a file that 'export --delta' wrote"
        raise ModelError(str(delta), expected="a delta", got=got, remedy=remedy) from error
    core, name = with_delta(required_family(model).core, packed, str(delta))
    return host_model(core, {**metadata(model), "sensor": name}, fixed_tile_px(model))
