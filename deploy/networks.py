"""Which network a command means: a file of the user's, or a shipped one specialised to a sensor.

A shipped network is one set of weights for every sensor in range. NAME is that network in float32 and NAME-int8 in
INT8, each for one sensor. Both are ONNX files, made when they are first asked for and kept in a cache by what they
depend on: weights, the sensor's numbers, and for INT8 the code that makes it. For the shipped sensor profiles the
INT8 files are shipped too: the very bytes that would be made. A network behind the bank of its sensor is calibrated
once for all sensors; its INT8 file is then told each.
"""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import onnx
import platformdirs

from deploy.cache import code_digest, digest_of
from deploy.export import float_for
from model.bank import REFERENCE, bank_of_vector, network_bank
from model.io.files import require_writable, sha256
from model.io.tensors import BANKED, is_conditioned, kind_of, read_banked
from model.progress import steps
from model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_names, shipped_weights
from model.specialise import RANGES, sensor_vector
from profiles.errors import ModelError
from profiles.sensor import SensorProfile, numbers_of
from profiles.sensor_file import load_sensor
from profiles.toml import unreadable
from quant.banked.family import FAMILY, required_family, with_delta
from quant.core import SHIFTS, Shifts
from quant.encodings import host_model
from quant.onnx_file import fixed_tile_px, is_quantised, load_onnx, metadata, save_onnx

MAKING = {"float32": ("deploy.export",), "int8": ("quant.quantise", "quant.calibration", "quant.banked.calibrate")}
"""The modules that make a file of each precision: with other code they are made anew."""

MADE_FROM = "made_from"
"""In the metadata of a file: a digest of weights and sensor."""

WEIGHTS = "weights_sha256"
"""In the metadata of an INT8 network behind a bank: the SHA-256 of its float weights."""

PATCHES, PATCH_PX, SEED = 64, 128, 0
"""Of calibration, on drawn scenes: what `quantize` takes where nothing else is asked for."""

CACHE_VARIABLE = "BEERS_DEPLOY_CACHE"

Say = Callable[[str], None]
"""Tells a sentence as the work goes on."""


def silent(_: str) -> None:
    """Tell nobody."""


def once(say: Say) -> Say:
    """Tells each sentence the first time alone: several networks of one sensor have the same to say."""
    told = set[str]()

    def tell(sentence: str) -> None:
        if sentence not in told:
            told.add(sentence)
            say(sentence)

    return tell


@dataclass(frozen=True)
class Conditioned:
    """Weights of a conditioned network, and the name that it is listed under."""

    name: str
    weights: Path


def conditioned(given: Path | None) -> Conditioned | None:
    """The conditioned network that is meant, None meaning the default one; None for any other file.

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
    """The weights given, or the shipped ones of that name where no such file lies; nothing is read."""
    return shipped_weights(given.name.removesuffix(INT8)) if _is_shipped(given) else given


def _is_shipped(given: Path) -> bool:
    """Whether a shipped network is meant by its name, with INT8 behind it or without."""
    named = given == Path(given.name) and given.name.removesuffix(INT8) in shipped_names()
    return named and not given.exists()


def network_file(given: Path | None, sensor: SensorProfile, say: Say = silent) -> Path:
    """The file of a network: the one given, or a conditioned network's for the sensor, INT8 where its name says so.

    Args:
        given: a file, or a shipped name where no such file lies; None is the default network in INT8.
        sensor: what a conditioned network is specialised to: the middle of each of its ranges.
        say: is told what of the sensor lies outside the range that was trained.

    Raises:
        ModelError: weights that cannot be read, or a name that is neither a file's nor a shipped network's.
        MachineError: the cache cannot be written.
    """
    if given is not None and not (given.suffix or given.exists() or _is_shipped(given)):
        expected = f"a file, or a shipped network ({', '.join(shipped_names())}, each also with {INT8})"
        raise ModelError(str(given), expected=expected, got="neither", remedy="correct the name, or the path")
    int8 = given is None or given.name.endswith(INT8)
    return int8_file(given, sensor, say) if int8 else float_file(given, sensor, say)


def float_file(given: Path | None, sensor: SensorProfile, say: Say = silent) -> Path:
    """As `network_file`, a conditioned network always in float32.

    Raises:
        ModelError: weights that cannot be read.
        MachineError: the cache cannot be written.
    """
    found = conditioned(given)
    return _kept(found, sensor, "float32", say) if found else given or Path()


def int8_file(given: Path | None, sensor: SensorProfile, say: Say = silent) -> Path:
    """As `network_file`, a conditioned network always in INT8.

    Raises:
        ModelError: weights that cannot be read.
        MachineError: the cache cannot be written.
    """
    found = conditioned(given)
    return _kept(found, sensor, "int8", say) if found else given or Path()


def shipped_pair(name: str = VARIANT, sensor: str = SENSOR, say: Say = silent) -> tuple[Path, Path]:
    """A shipped network in float32 and in INT8, specialised to a sensor.

    Raises:
        ModelError: no network of that name is shipped.
        ProfileError: no such sensor.
        MachineError: the cache cannot be written.
    """
    known, given = load_sensor(sensor), Path(shipped_weights(name).stem)
    return float_file(given, known, say), int8_file(given, known, say)


def specialised_model(network: Conditioned, sensor: SensorProfile, say: Say) -> onnx.ModelProto:
    """A conditioned network in float32 for one sensor, as ONNX."""
    model, outside = float_for(network.weights, network.name, sensor)
    for sentence in outside:
        say(f"warning: {sentence}")
    return model


def other_precision(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """A shipped network of the same variant in the other precision, or None; its weights may be others.

    Time depends on the shapes, not on the weights: for a comparison of time any weights will do.
    """
    variant = metadata(model).get("variant", "")
    if variant not in shipped_names():
        return None
    find = float_file if is_quantised(model) else int8_file
    return load_onnx(find(Path(variant), load_sensor(SENSOR)))


def cache_folder() -> Path:
    """Where specialised networks are kept: the user's cache, or what the environment names in its place."""
    own = os.environ.get(CACHE_VARIABLE)
    return Path(own) if own else platformdirs.user_cache_path("beers-deploy")


def _kept(network: Conditioned, sensor: SensorProfile, precision: str, say: Say) -> Path:
    for sentence in sensor_vector(sensor.nominal()).outside:
        say(f"warning: {sentence}")
    made_from = digest_of({"weights": sha256(network.weights), "sensor": numbers_of(sensor)})
    shipped = SHIPPED / f"{network.name}{INT8}-{sensor.name}.onnx"
    if precision == "int8" and shipped.is_file() and metadata(load_onnx(shipped)).get(MADE_FROM) == made_from:
        return shipped
    stem = network.name + (INT8 if precision == "int8" else "")
    known = re.sub(r"[^\w.-]+", "-", sensor.name)[:40]
    digest = digest_of([made_from, precision, code_digest(*MAKING[precision])])
    path = cache_folder() / f"{stem}-{known}-{digest[:12]}.onnx"
    if not path.is_file():
        require_writable(path)
        save_onnx(_made(network, sensor, precision, {MADE_FROM: made_from}), path)
    return path


def _made(network: Conditioned, sensor: SensorProfile, precision: str, more: dict[str, str]) -> onnx.ModelProto:
    if precision == "int8" and kind_of(network.weights) == BANKED:
        return told_int8(load_onnx(_family_file(network)), sensor, more)
    model = specialised_model(network, sensor, silent)
    return _in_int8(model, sensor, more) if precision == "int8" else model


def told_int8(
    model: onnx.ModelProto, sensor: SensorProfile, more: dict[str, str], say: Say = silent
) -> onnx.ModelProto:
    """An INT8 network behind a bank told another sensor: its filters, unit and head's bias written anew.

    Args:
        model: of whatever sensor.
        sensor: of which the middle is taken.
        more: metadata to add.
        say: is told what of the sensor lies outside the range that was trained.

    Raises:
        ModelError: no such file.
    """
    family, known = required_family(model), sensor.nominal()
    vector = sensor_vector(known)
    for sentence in vector.outside:
        say(f"warning: {sentence}")
    core = family.for_sensor(network_bank(known), vector.values)
    return host_model(core, {**metadata(model), "sensor": sensor.name, **more}, fixed_tile_px(model))


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


def _family_file(network: Conditioned) -> Path:
    """The INT8 file of a network behind a bank, shipped, or made once of a user's own weights."""
    shipped = SHIPPED / f"{network.name}{INT8}.onnx"
    weights = sha256(network.weights)
    if shipped.is_file() and metadata(load_onnx(shipped)).get(WEIGHTS) == weights:
        return shipped
    path = cache_folder() / f"{network.name}{INT8}-{weights[:12]}-{code_digest(*MAKING['int8'])[:12]}.onnx"
    if not path.is_file():
        require_writable(path)
        save_onnx(family_model(network), path)
    return path


def behind_bank(given: Path) -> Conditioned | None:
    """The network behind the bank of its sensor that is meant, a file's or a shipped one; None for any other.

    Raises:
        ModelError: weights that cannot be read.
    """
    found = conditioned(given)
    return found if found and kind_of(found.weights) == BANKED else None


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
    from model.simulator.procedural import load_scenes  # torch, which what is kept already does not need
    from quant.banked.calibrate import family_images, family_ticks, quantise_family

    weights = read_banked(network.weights)
    scenes, scale = load_scenes(images, load_sensor(REFERENCE).nominal(), seed), weights.variant.scale
    with steps(f"calibrating {network.name} over the family of sensors", family_ticks(weights)) as bar:
        seen, middle = family_images(scenes, scale, seed), bank_of_vector((0.0,) * len(RANGES))
        family = quantise_family(weights, middle, seen, bar.advance, shifts)
    said = {"variant": network.name, "reference": REFERENCE, "precision": "int8 legal", "calibration_seed": str(seed)}
    return host_model(family.core, {**said, FAMILY: family.to_words(), WEIGHTS: sha256(network.weights)})


def _in_int8(model: onnx.ModelProto, sensor: SensorProfile, more: dict[str, str]) -> onnx.ModelProto:
    from model.simulator.procedural import load_scenes  # torch, which what is kept already does not need
    from profiles.sensor_file import reference_for
    from quant.calibration import draw_patches
    from quant.quantise import quantise_model, ticks

    reference = reference_for(sensor)
    scenes = load_scenes(None, reference.nominal(), SEED)
    patches = draw_patches(scenes, sensor, reference, PATCHES, SEED, PATCH_PX)
    about = {"calibration_sensor": sensor.name, "calibration_seed": str(SEED), **more}
    with steps(f"making INT8 for {sensor.name}, once", ticks(model, PATCHES)) as bar:
        return quantise_model(model, patches, about, bar.advance).host
