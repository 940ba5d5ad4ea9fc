"""Read and write weights as safetensors: named arrays and a JSON header, without torch and
validated.

A weights file of this project states its variant and the recipe that made it. If the network is
conditioned on a sensor, it also states its kind and the ranges of its training sensors.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from beers_deploy.model.family import RANGES
from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.formats import HEAD_BYTES, SAFETENSORS, other_format
from beers_deploy.model.levels import INTERVAL
from beers_deploy.model.variants import Kernels, Variant
from beers_deploy.profiles.errors import ModelError, printable, reason_of
from beers_deploy.profiles.user_files.json_text import parse_json
from beers_deploy.profiles.user_files.whole import unreadable

BANKED = "behind the bank of its sensor"
"""The kind, in the header, of weights that need a sensor to form a network; plain weights state
none.
"""

TRAINED = "Give a file written by 'beers-deploy train'"

FAULTS = (AttributeError, LookupError, TypeError, ValueError, OverflowError, RuntimeError)
"""Exceptions that reading a header or filling a network may raise for a file of another origin."""

Arrays = Mapping[str, np.ndarray]
"""Arrays of any shape by name."""


@dataclass(frozen=True)
class Weights:
    """The content of a weights file.

    Attributes:
        tensors: the weights and biases by name.
        variant: the size of the network.
        recipe: how the network was trained, for its model card.
        conditioned: True if one set of weights serves every sensor: the network then reads the
            image through a filter bank computed from the sensor.
        kernels: the kind of kernels of this bank.
        interval: the calibrated interval of its errors as text (`model.interval`); "" without one.
    """

    tensors: Arrays
    variant: Variant
    recipe: dict[str, object]
    conditioned: bool = False
    kernels: Kernels = "fitted"
    interval: str = ""


def write_tensors(path: Path, tensors: Arrays, header: Mapping[str, object]) -> None:
    """Write named arrays of any shape and a JSON header as safetensors, whole or not at all."""
    contiguous = {name: np.asarray(array, order="C") for name, array in tensors.items()}
    content = save(contiguous, metadata={key: json.dumps(value) for key, value in header.items()})
    # The file begins with the length of its JSON header, in 8 bytes. The library writes the
    # metadata in it in random order, so they are sorted by key.
    end = 8 + int.from_bytes(content[:8], "little")
    stored = json.loads(content[8:end])
    stored["__metadata__"] = dict(sorted(stored.get("__metadata__", {}).items()))
    text = json.dumps(stored, separators=(",", ":"), ensure_ascii=False).encode()
    # The tensors begin at a multiple of 8.
    text += b" " * (-len(text) % 8)
    with whole_file(path) as temporary:
        # The library's own writer reports a full disk with an error of its own.
        temporary.write_bytes(len(text).to_bytes(8, "little") + text + content[end:])


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read the named arrays, of any shape, and the JSON header of a safetensors file.

    Raises:
        ModelError: the file cannot be read, or is no safetensors file.
    """
    fault = unreadable(path)
    try:
        if fault is not None:
            raise OSError(fault)
        with safe_open(path, framework="np") as file:
            header = {key: parse_json(value) for key, value in (file.metadata() or {}).items()}
            # Copies: the library's own lie in the file, which Windows then does not replace, and
            # others may change.
            return {key: np.array(file.get_tensor(key)) for key in file.keys()}, header  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        name = printable(str(path))
        other = None
        if fault is None:
            with suppress(OSError), path.open("rb") as stream:
                other = other_format(stream.read(HEAD_BYTES))
        if other not in (None, SAFETENSORS):
            raise ModelError(
                f"{name} must hold safetensors weights, but it is {other.name}. {TRAINED}, or an "
                f"ONNX file of your own network: {other.remedy}."
            ) from error
        reason = fault or reason_of(error)
        raise ModelError(f"{name} holds no safetensors weights: {reason}. {TRAINED}.") from error


def read_weights(path: Path) -> Weights:
    """Read the weights of a network, plain or conditioned on a sensor, or raise ModelError."""
    tensors, header = read_tensors(path)
    try:
        conditioned = _conditioned(header)
        shape: Any = header["variant"]
        variant = Variant(int(shape["blocks"]), int(shape["features"]), int(shape.get("scale", 1)))
        if variant.scale < 1:
            raise ValueError(f"it states a scale of {variant.scale}")
        # This is checked before a list of the network's size is made, because a header alone must
        # not take memory.
        if len(tensors) != 4 * variant.blocks + (7 if conditioned else 6):
            raise ValueError(f"it has {len(tensors)} tensors for {variant}")
        shapes = variant.banked_shapes if conditioned else variant.shapes
        for name, expected in shapes.items():
            if tensors[name].shape != expected:
                raise ValueError(
                    f"{name} has the shape {tensors[name].shape} instead of {expected}"
                )
        is_float32 = all(tensor.dtype == np.float32 for tensor in tensors.values())
        if not is_float32 or not all_finite(tensors):
            raise ValueError("its weights are not finite float32")
    except FAULTS as error:
        reason = reason_of(error)
        if isinstance(error, KeyError):
            reason = f"it has no {reason}"
        raise ModelError(
            f"{path} does not hold the weights of a ConvBEERS: {reason}. {TRAINED}."
        ) from error
    recipe = header.get("recipe")
    kernels: Kernels = "fitted" if header.get("kernels") == "fitted" else "cut"
    return Weights(
        tensors,
        variant,
        recipe if isinstance(recipe, dict) else {},
        conditioned,
        kernels,
        str(header.get(INTERVAL, "")),
    )


def read_plain(path: Path) -> Weights:
    """Read the weights of a plain network, or raise ModelError if it is conditioned on a sensor."""
    weights = read_weights(path)
    if weights.conditioned:
        raise ModelError(
            f"{path} must hold the weights of a plain network, but its network is conditioned on "
            "a sensor. Name the sensor: beers-deploy export --network FILE --sensor NAME."
        )
    return weights


def read_conditioned(path: Path) -> Weights:
    """Read the weights of a network that is conditioned on a sensor, or raise ModelError."""
    weights = read_weights(path)
    if not weights.conditioned:
        raise ModelError(
            f"{path} must hold weights that 'train --conditioned' wrote, but its network is not "
            f"conditioned on a sensor. {TRAINED}."
        )
    return weights


def is_conditioned(path: Path) -> bool:
    """Return True if a weights file states that its network is conditioned on a sensor."""
    return read_tensors(path)[1].get("kind") is not None


def all_finite(tensors: Arrays) -> bool:
    """Return True if every value of every array is finite."""
    return all(bool(np.isfinite(tensor).all()) for tensor in tensors.values())


def _conditioned(header: Mapping[str, object]) -> bool:
    """Return True if the network is conditioned on its sensor; raise ValueError for
    other versions.
    """
    kind = header.get("kind")
    if kind not in (None, BANKED):
        raise ValueError(f"its kind of weights, {kind!r}, is that of another version")
    if kind and header.get("ranges") != {name: list(ends) for name, ends in RANGES.items()}:
        raise ValueError("its ranges of sensors differ from those of this version")
    return kind is not None
