"""The interval of a network, fitted on pairs and stored in a copy of its file."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import onnx

from beers_deploy.model.interval import PixelInterval
from beers_deploy.model.interval_calibration import Sample, calibrated
from beers_deploy.model.io.tensors import read_tensors, write_tensors
from beers_deploy.model.levels import INTERVAL
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import load_onnx, metadata, save_onnx
from beers_deploy.restoration.method import Restore
from beers_deploy.studies.evaluation.methods import network_and_sensor
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.run import Evaluation

logger = logging.getLogger(__name__)

SUFFIXES = (".onnx", ".safetensors")


def network_to_calibrate(methods: Mapping[str, Any], out: Path) -> tuple[str, Path]:
    """Return which of the compared methods `evaluate --calibrate` calibrates: the only file of a
    network.

    Args:
        methods: the compared methods (names, paths, networks or functions), by the name of their
            row.
        out: the path of the calibrated copy to write.

    Returns:
        The name of the method, and the path of its network's file.

    Raises:
        OptionError: none or several methods are files of networks, or `out` has another suffix than
            the file.
    """
    named = {name: Path(network_and_sensor(str(source))[0]) for name, source in methods.items()}
    files = {name: path for name, path in named.items() if path.suffix in SUFFIXES}
    if len(files) != 1:
        raise OptionError(
            "`calibrate` needs one file of a network in `methods`, .onnx or .safetensors, got "
            f"{len(files)}. Name it alone: --methods network.onnx."
        )
    ((name, path),) = files.items()
    if out.suffix != path.suffix:
        raise OptionError(
            f"`calibrate` must end in {path.suffix}, as {path.name} does, got {out.name}."
        )
    return name, path


def calibrate_network(evaluation: Evaluation, name: str, source: Path, out: Path) -> None:
    """Fit the interval of a network's restored pixels on the pairs of an evaluation, and store it
    in a copy of the network's file.

    The interval of a pixel is the range that its true value lies in with a stated probability.

    Args:
        evaluation: the evaluation, whose pairs show the error of the network.
        name: the name of the network among the methods of the evaluation.
        source: the path of the network's file, ONNX or safetensors.
        out: the path of the copy.

    Raises:
        ImageError: all pairs are of one site.
    """
    (method,) = (method for method in evaluation.methods if method.name == name)
    interval = interval_from_pairs(evaluation.pairs, method.restore, evaluation.sensors[0])
    write_with_interval(source, interval, out)
    levels = ", ".join(f"{level} %" for level in interval.quantiles)
    logger.info("wrote %s: intervals of %s, of %d images", out, levels, interval.acquisitions)


def interval_from_pairs(
    pairs: Sequence[NamedPair], restore: Restore, sensor: Sensor
) -> PixelInterval:
    """Fit the interval of a method's restored pixels, by the formula of `model.interval`.

    The sites of the pairs are split in two halves: one fits how the half-width grows with detail,
    blur and noise, the other the factor that makes the interval hold the stated share of pixels.

    Args:
        pairs: the pairs of at least two sites. The truth is the reference without noise where it is
            known, else the reference.
        restore: the method, a function from degraded to restored digital numbers (H, W).
        sensor: the sensor that acquired the degraded images.

    Raises:
        ImageError: all pairs are of one site.
    """
    sites = sorted({pair.site for pair in pairs})
    if len(sites) < 2:
        raise ImageError(
            "`calibrate` needs pairs of at least two sites: one part fits the interval, the other "
            f"calibrates it. These are all of {sites[0]}."
        )
    parts: tuple[list[Sample], list[Sample]] = ([], [])
    for pair in pairs:
        restored = restore(pair.degraded)
        sample = Sample.of(pair.degraded, restored, pair.truth, sensor.nominal())
        parts[sites.index(pair.site) % 2].append(sample)
    # The larger part calibrates, because a level needs so many images.
    return calibrated(*sorted(parts, key=len))


def write_with_interval(source: Path, interval: PixelInterval, out: Path) -> None:
    """Write a copy of a network's file that also states the interval of its restored pixels.

    The network's results stay the same. A float ONNX file is written in its simplified form.

    Args:
        source: the path of the network's file, ONNX or safetensors.
        interval: the calibrated interval.
        out: the path of the copy.
    """
    text = interval.to_json()
    if source.suffix == ".safetensors":
        tensors, header = read_tensors(source)
        write_tensors(out, tensors, {**header, INTERVAL: text})
        return
    model = load_onnx(source)
    onnx.helper.set_model_props(model, {**metadata(model), INTERVAL: text})
    save_onnx(model, out)
