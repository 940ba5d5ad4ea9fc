"""Which network a command means: a file of the user's, or a shipped one told a sensor.

A shipped network is one set of weights, and one INT8 file, for every sensor in range. NAME is that network in float32
and NAME-int8 in INT8, each told one sensor: its filters, written in milliseconds from the profile alone. Where a file
is needed it lies in a folder of this process, which goes with it.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import onnx

from beers_deploy.export import float_for
from beers_deploy.model.bank import REFERENCE, bank_of_vector, network_bank
from beers_deploy.model.family import RANGES, sensor_vector
from beers_deploy.model.io.files import sha256
from beers_deploy.model.io.tensors import is_conditioned, read_conditioned
from beers_deploy.model.progress import Log, no_log, progress
from beers_deploy.model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_names, shipped_weights
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.sensor import Sensor, numbers_of
from beers_deploy.profiles.sensor_file import load_sensor
from beers_deploy.profiles.toml import unreadable
from beers_deploy.quant.banked.family import FAMILY, required_family, with_delta
from beers_deploy.quant.core import SHIFTS, Shifts
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.onnx_file import fixed_tile_px, is_quantised, load_onnx, metadata, save_onnx

WEIGHTS = "weights_sha256"
"""In the metadata of an INT8 network behind a bank: the SHA-256 of its float weights."""

SEED = 0
"""Of calibration, on drawn scenes: what `quantize` takes where nothing else is asked for."""


@dataclass(frozen=True)
class Conditioned:
    """Weights of a network that is told its sensor, and the name that it is listed under."""

    name: str
    weights: Path

    def model(self, sensor: Sensor, int8: bool) -> onnx.ModelProto:
        """The network told a sensor, in float32 or in INT8.

        Raises:
            ModelError: INT8 of other weights than the shipped ones, which must be calibrated first.
        """
        if not int8:
            return float_for(self.weights, self.name, sensor)
        shipped = SHIPPED / f"{self.name}{INT8}.onnx"
        if self.weights.parent != SHIPPED:
            remedy = f"make one for every sensor: beers-deploy quantize {self.weights} --out {self.name}{INT8}.onnx"
            raise ModelError(str(self.weights), expected="an INT8 network", got="float weights", remedy=remedy)
        return told_int8(load_onnx(shipped), sensor)


def conditioned(given: Path | None) -> Conditioned | None:
    """The network to be told its sensor that is meant, None meaning the default one; None for any other file.

    Raises:
        ModelError: weights that cannot be read.
    """
    if given is None:
        return Conditioned(VARIANT, shipped_weights(VARIANT))
    if _is_shipped(given):
        name = given.name.removesuffix(INT8)
        return Conditioned(name, shipped_weights(name))
    return Conditioned(given.stem, given) if given.suffix == ".safetensors" and is_conditioned(given) else None


def weights_file(given: Path) -> Path:
    """The file given, or the shipped one of that name where no such file lies; nothing is read."""
    if not _is_shipped(given):
        return given
    return SHIPPED / f"{given.name}.onnx" if given.name.endswith(INT8) else shipped_weights(given.name)


def _is_shipped(given: Path) -> bool:
    """Whether a shipped network is meant by its name, with INT8 behind it or without."""
    named = given == Path(given.name) and given.name.removesuffix(INT8) in shipped_names()
    return named and not given.exists()


def network_file(given: Path | None, sensor: Sensor, log: Log = no_log) -> Path:
    """The file of a network: the one given, or a conditioned network's for the sensor, INT8 where its name says so.

    Args:
        given: a file, or a shipped name where no such file lies; None is the default network in INT8.
        sensor: what a conditioned network is told: the middle of each of its ranges.
        log: is told what of the sensor lies outside the range that was trained.

    Raises:
        ModelError: weights that cannot be read, or a name that is neither a file's nor a shipped network's.
    """
    if given is not None and not (given.suffix or given.exists() or _is_shipped(given)):
        expected = f"a file, or a shipped network ({', '.join(shipped_names())}, each also with {INT8})"
        raise ModelError(str(given), expected=expected, got="neither", remedy="correct the name, or the path")
    int8 = given is None or given.name.endswith(INT8)
    return int8_file(given, sensor, log) if int8 else float_file(given, sensor, log)


def float_file(given: Path | None, sensor: Sensor, log: Log = no_log) -> Path:
    """As `network_file`, a conditioned network always in float32.

    Raises:
        ModelError: weights that cannot be read.
    """
    found = conditioned(given)
    return _written(found, sensor, False, log) if found else given or Path()


def int8_file(given: Path | None, sensor: Sensor, log: Log = no_log) -> Path:
    """As `network_file`, a conditioned network always in INT8.

    Raises:
        ModelError: weights that cannot be read, or that are not calibrated yet.
    """
    found = conditioned(given)
    return _written(found, sensor, True, log) if found else given or Path()


def shipped_pair(name: str = VARIANT, sensor: str = SENSOR, log: Log = no_log) -> tuple[Path, Path]:
    """A shipped network in float32 and in INT8, told a sensor.

    Raises:
        ModelError: no network of that name is shipped.
        ProfileError: no such sensor.
    """
    known, given = load_sensor(sensor), Path(shipped_weights(name).stem)
    return float_file(given, known, log), int8_file(given, known, log)


def warn_outside(sensor: Sensor, log: Log) -> None:
    """Tell what of a sensor lies outside the range that was trained."""
    for sentence in sensor_vector(sensor.nominal()).outside:
        log(f"warning: {sentence}")


def other_precision(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """A shipped network of the same variant in the other precision, or None; its weights may be others.

    Time depends on the shapes, not on the weights: for a comparison of time any weights will do.
    """
    variant = metadata(model).get("variant", "")
    if variant not in shipped_names():
        return None
    find = float_file if is_quantised(model) else int8_file
    return load_onnx(find(Path(variant), load_sensor(SENSOR)))


@cache
def _folder() -> TemporaryDirectory[str]:
    """Where the files of this process lie."""
    return TemporaryDirectory(prefix="beers-deploy-", ignore_cleanup_errors=True)


def _written(network: Conditioned, sensor: Sensor, int8: bool, log: Log) -> Path:
    warn_outside(sensor, log)
    stem = network.name + (INT8 if int8 else "")
    known = re.sub(r"[^\w.-]+", "-", sensor.name)[:40]
    told = json.dumps({"weights": sha256(network.weights), "sensor": numbers_of(sensor)}, sort_keys=True, default=str)
    path = Path(_folder().name) / f"{stem}-{known}-{hashlib.sha256(told.encode()).hexdigest()[:12]}.onnx"
    if not path.is_file():
        save_onnx(network.model(sensor, int8), path)
    return path


def told_int8(
    model: onnx.ModelProto, sensor: Sensor, more: Mapping[str, str] | None = None, log: Log = no_log
) -> onnx.ModelProto:
    """An INT8 network behind a bank told another sensor: its filters, unit and head's bias written anew.

    Args:
        model: of whatever sensor.
        sensor: of which the middle is taken.
        more: metadata to add.
        log: is told what of the sensor lies outside the range that was trained.

    Raises:
        ModelError: no such file.
    """
    warn_outside(sensor, log)
    known = sensor.nominal()
    core = required_family(model).for_sensor(network_bank(known), sensor_vector(known).values)
    return host_model(core, {**metadata(model), "sensor": sensor.name, **(more or {})}, fixed_tile_px(model))


def told_by_delta(model: onnx.ModelProto, delta: Path) -> onnx.ModelProto:
    """An INT8 network behind a bank told the sensor of a delta, a file that `export --delta` wrote.

    Raises:
        ModelError: no such network, no delta, or one of another network.
    """
    try:
        packed = delta.read_bytes()
    except OSError as error:
        remedy = "give a file that 'export --delta' wrote"
        raise ModelError(
            str(delta), expected="a delta", got=unreadable(delta) or str(error), remedy=remedy
        ) from error
    core, name = with_delta(required_family(model).core, packed)
    return host_model(core, {**metadata(model), "sensor": name}, fixed_tile_px(model))


def family_model(
    network: Conditioned, images: Path | None = None, seed: int = SEED, shifts: Shifts = SHIFTS
) -> onnx.ModelProto:
    """The INT8 file of a network behind a bank, for the middle of the family; any sensor can be told to it.

    Args:
        network: of weights that 'train --conditioned' wrote.
        images: folder of scenes that the family sees while it is calibrated; None draws some.
        seed: of the patches.
        shifts: the windows of the target.

    Raises:
        ModelError: other weights.
    """
    from beers_deploy.model.simulator.procedural import load_scenes  # torch, which a restoration does not need
    from beers_deploy.quant.banked.calibrate import family_images, quantise_family

    weights = read_conditioned(network.weights)
    scenes, scale = load_scenes(images, load_sensor(REFERENCE).nominal(), seed), weights.variant.scale
    with progress(f"calibrating {network.name} over the family of sensors") as log:
        seen, middle = family_images(scenes, scale, seed), bank_of_vector((0.0,) * len(RANGES))
        family = quantise_family(weights, middle, seen, shifts, log)
    said = {"variant": network.name, "reference": REFERENCE, "precision": "int8 legal", "calibration_seed": str(seed)}
    return host_model(family.core, {**said, FAMILY: family.to_words(), WEIGHTS: sha256(network.weights)})
