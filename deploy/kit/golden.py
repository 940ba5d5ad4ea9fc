"""Golden vectors: the expected output of every layer of an INT8 network on a board.

A folder holds the network (int8.onnx), golden.json and, for each case, its image and the int8
tensors of all layers. These are .npy files (N, C, H, W), numbered in the order in which they are
computed.
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy import __version__
from beers_deploy.dpu.board import BoardLike, device_of
from beers_deploy.model.io.files import whole_file, write_text
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import ImageError, OptionError, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.user_files.arrays import ALONE, load_arrays
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.profiles.user_files.whole import unreadable
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import read_core, require_undamaged
from beers_deploy.quant.graph import PLANES
from beers_deploy.quant.input_range import from_shares
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import faults_named
from beers_deploy.quant.untrusted import times
from beers_deploy.results import Input, Table

SCHEMA = "beers-deploy/golden"
SCHEMA_VERSION = 1
GOLDEN_TILE_PX = 64
INDEX = "golden.json"
NETWORK = "int8.onnx"
PICTURE = "image.npy"
SCENE_PX = 8
"""Pixels of the drawn scene per pixel of an image, along each axis."""


def write_golden(
    int8: NetworkLike,
    out: str | os.PathLike[str],
    *,
    tile: int | None = None,
    target: BoardLike = DEFAULT_TARGET,
) -> Path:
    """Write golden vectors of an INT8 network: the values that a board must compute in each layer.

    Args:
        int8: the network, quantised under a board's rules.
        out: the folder to write. Older golden vectors in it are deleted.
        tile: side of the square test images in pixels; None for the size that the network is fixed
            to, or the first multiple of its alignment from 64 pixels on.
        target: the board, which decides how halves are rounded: up on a DPU, to even on an NPU.

    Returns:
        The path of the folder.

    Raises:
        ModelError: the network was not made by `quantize`.
        OptionError: the network does not accept images of this size, or the board has neither a
            DPU nor an NPU.
    """
    network = Network.load(int8, int8=True)
    # A board that computes the right numbers would be called wrong.
    require_undamaged(network.model, network.label)
    folder = Path(out)
    with faults_named(network.label):
        core = read_core(network.model)
    # AMD's kernel for its NPU rounds ties to even.
    half_even = bool(device_of(TargetProfile.load(target)).target.npu)
    names = files_of(core)
    generator = np.random.default_rng(0)
    images = _images(network, core.host_part.image_channels, tile, generator)
    ranges = core.host_part.input_ranges
    images = {case: from_shares(image, ranges) for case, image in images.items()}
    planes = {case: core.host_part.encode(image) for case, image in images.items()}
    planes[EXTREMES] = generator.choice(np.array([-128, 127], np.int8), planes["noise"].shape)
    _remove_older(folder)
    digests = dict[str, dict[str, str]]()
    for case, case_planes in planes.items():
        tensors, _ = run_core(core, case_planes, half_even)
        digests[case] = {file: _digest(tensors[name]) for name, file in names.items()}
        for name, file in names.items():
            save_array(folder / case / file, tensors[name].astype(np.int8))
        if case in images:
            save_array(folder / case / PICTURE, images[case])
    network.save(folder / NETWORK)
    facts: dict[str, dict[str, object]] = {
        op.output: {"layer": op.name, "operator": type(op).__name__, "reads": list(op.inputs)}
        for op in core.ops
    }
    facts[PLANES] = {"layer": "the planes that the core reads", "operator": "", "reads": []}
    index = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "tool_version": __version__,
        "cases": digests,
        "network": network.input._asdict(),
        "half_even": half_even,
        "layers": [
            {"file": file, "tensor": name, **facts[name], "fractional_bits": core.frac_bits[name]}
            for name, file in names.items()
        ],
    }
    write_text(folder / INDEX, json.dumps(index, indent=1) + "\n")
    return folder


def vectors_table(folder: Path) -> Table:
    """List the cases (test images) in a folder of golden vectors, with the number of tensors.

    Args:
        folder: a folder that `write_golden` wrote.

    Raises:
        OptionError: the folder has no index, or a damaged one.
    """
    digests, _ = _index(folder)
    rows = [Row("cases", case, {}, {"tensors": str(len(files))}) for case, files in digests.items()]
    return Table(title=f"golden vectors in {folder}", inputs=(folder / NETWORK,), rows=tuple(rows))


def _remove_older(folder: Path) -> None:
    """Delete the golden vectors in a folder. Otherwise files of layers that are not written again
    would remain.
    """
    index = folder / INDEX
    if not index.is_file():
        return
    # The index goes first: if this stops, the files that are left must not pass as complete.
    index.unlink()
    for case in CASES:
        # A link may lead to files that are not ours.
        if not (folder / case).is_symlink():
            for path in (folder / case / PICTURE, *(folder / case).glob("[0-9]*-*.npy")):
                path.unlink(missing_ok=True)


def files_of(core: IntCore) -> dict[str, str]:
    """Return the file name of every tensor of an integer core, by the name of the tensor.

    File names begin with a number in the order of computation, such as "03-body.0.relu.npy". The
    first tensor is the input of the core.
    """
    tensors = [PLANES, *(op.output for op in core.ops)]
    return {
        name: f"{k:02d}-{re.sub(r'[^A-Za-z0-9._-]+', '_', name)}.npy"
        for k, name in enumerate(tensors)
    }


EXTREMES = "extremes"
"""The case whose planes are -128 and 127 in random order, which no image produces."""
CASES = ("scene", "noise", "steps", "black", "white", "odd", EXTREMES)


def _images(
    network: Network, channels: int, tile: int | None, generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return the images (1, C, H, W) of the cases, by name."""
    fixed_px = fixed_tile_px(network.model)
    alignment_px = fixed_px or network.tiling.alignment_px
    side = fixed_px or tile or up_to_multiple(GOLDEN_TILE_PX, alignment_px)
    if (tile or side) != side or side < 1 or side % alignment_px:
        rule = (
            f"{fixed_px} px, the network's own size"
            if fixed_px
            else f"a multiple of {alignment_px} px"
        )
        raise OptionError(f"`tile` of this network must be {rule}, got {tile} px. Choose another.")
    shape = 1, channels, side, side
    steps = np.indices((side, side)).sum(0) // 8 % 2
    steps[3::11, 5::13] = 1
    images = {
        "scene": _scene(channels, side, side, generator),
        "noise": generator.random(shape, dtype=np.float32),
        "steps": np.broadcast_to(steps.astype(np.float32), shape).copy(),
        "black": np.zeros(shape, np.float32),
        "white": np.ones(shape, np.float32),
    }
    if not fixed_px:
        # `| 1` makes the number of lattice steps odd along both sides.
        rows, columns = (alignment_px * (side * part // (8 * alignment_px) | 1) for part in (5, 7))
        images["odd"] = _scene(channels, rows, columns, generator)
    return images


def _scene(channels: int, rows: int, columns: int, generator: np.random.Generator) -> np.ndarray:
    """Draw a scene (1, C, rows, columns) in [0, 1], each channel slightly darker than the one
    before.
    """
    # This loads SciPy, which no other case needs.
    from beers_deploy.model.simulator.procedural import procedural_scene

    radiance = procedural_scene(SCENE_PX * rows, SCENE_PX * columns, generator).radiance
    mean = radiance.reshape(rows, SCENE_PX, columns, SCENE_PX).mean((1, 3))
    bright = mean / np.quantile(mean, 0.99)
    darker = 1 - 0.3 * np.arange(channels)[:, None, None] / channels
    return np.asarray(np.clip(bright * darker, 0, 1)[None], np.float32)


def save_array(path: Path, values: np.ndarray) -> None:
    """Write an array as a .npy file, atomically."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, values)


def _digest(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values, np.int8).tobytes()).hexdigest()


@dataclass(frozen=True)
class Golden:
    """The content of a folder of golden vectors: the values that a board must compute.

    Attributes:
        core: the integer core of the network.
        half_even: True if halves are rounded to even, False if they are rounded up.
        cases: the integers (N, C, H, W) of each tensor, by the name of the case and of the tensor.
        network: name and SHA-256 of the network's file in the folder.
    """

    core: IntCore
    half_even: bool
    cases: Mapping[str, Mapping[str, np.ndarray]]
    network: Input


def read_golden(folder: Path) -> Golden:
    """Read a folder that `write_golden` wrote.

    All tensors are computed again from the inputs in the folder, and compared with the digests in
    its index.

    Args:
        folder: the folder.

    Raises:
        OptionError: the folder has no index, a damaged one, or other numbers than were written.
        ImageError: a file is no array, or the inputs of a case are not int8 arrays of the network's
            channels.
    """
    digests, half_even = _index(folder)
    network = Network.load(folder / NETWORK)
    with faults_named(network.label):
        core = read_core(network.model)
    names = files_of(core)
    cases = {}
    for case, files in digests.items():
        planes = _planes(folder / case / names[PLANES], core)
        try:
            cases[case], _ = run_core(core, planes, half_even)
        # The planes may have a size that the network cannot rearrange.
        except (LookupError, ValueError) as error:
            raise OptionError(
                f"The planes in {folder / case} have the size {times(planes.shape)}, which the "
                f"network does not accept. {AGAIN}"
            ) from error
        for name, file in names.items():
            path = folder / case / file
            values = cases[case][name]
            # A board's engineer may use any of the files. Those that were not copied along are not
            # missed, because their values are computed again.
            if files.get(file) != _digest(values) or (
                path.exists() and not np.array_equal(read_array(path), values)
            ):
                raise _other_numbers(folder, case, file)
        picture = folder / case / PICTURE
        if picture.exists() and not _encodes_to(planes, read_array(picture), core):
            raise _other_numbers(folder, case, PICTURE)
    return Golden(core, half_even, cases, network.input)


def _other_numbers(folder: Path, case: str, file: str) -> OptionError:
    return OptionError(
        f"The golden vectors in {folder} are not those that were written: "
        f"{case}/{printable(file)} has other numbers. {AGAIN}"
    )


def _encodes_to(planes: np.ndarray, image: np.ndarray, core: IntCore) -> bool:
    """Return True if an image has the planes of its case: these have a digest, but it has none."""
    try:
        with np.errstate(invalid="ignore"):
            return np.array_equal(core.host_part.encode(image), planes)
    # Another size or type, which a damaged header states.
    except (LookupError, TypeError, ValueError):
        return False


AGAIN = "Write the folder again with 'beers-deploy golden'."


def _index(folder: Path) -> tuple[dict[str, dict[str, str]], bool]:
    """Return the digests of the files of each case, and True if ties were rounded to even."""
    path = folder / INDEX
    try:
        document: Any = read_json(path)
        if (document["schema"], document["schema_version"]) != (SCHEMA, SCHEMA_VERSION):
            raise ValueError(f"the schema {document['schema']}")
        digests = {str(case): dict(files) for case, files in document["cases"].items()}
        # A case is a folder next to the index. Another path would lead to files that nobody named.
        foreign = [case for case in digests if case in ("", ".", "..") or set(case) & set("/\\:")]
        if foreign:
            raise ValueError(f"the case {foreign[0]!r}")
        return digests, bool(document["half_even"])
    except (AttributeError, LookupError, OSError, TypeError, ValueError) as error:
        reason = unreadable(path) or f"it is damaged ({printable(str(error))[:80]})"
        raise OptionError(
            f"The index of golden vectors {path} cannot be read: {reason}. {AGAIN}"
        ) from error


def _planes(path: Path, core: IntCore) -> np.ndarray:
    """Read the planes that a core reads, (N, C, H, W) int8."""
    planes = read_array(path)
    channels = core.host_part.planes
    is_int8 = planes.dtype == np.int8 and planes.ndim == 4
    if not is_int8 or planes.shape[1] != channels or not planes.size:
        raise ImageError(
            f"{path} must hold int8 planes of shape (N, {channels}, H, W), got {planes.dtype} of "
            f"shape {planes.shape}. {AGAIN}"
        )
    return planes


def read_array(path: Path) -> np.ndarray:
    """Read the array of a .npy file.

    Raises:
        ImageError: the file is not readable as one array, or is an archive (.npz).
    """
    try:
        arrays = load_arrays(path)
        if list(arrays) != [ALONE]:
            raise ValueError("an archive of arrays")
    except ValueError as error:
        raise ImageError(
            f"{path} is not an array (.npy): {printable(str(error))}. Write it with numpy.save."
        ) from error
    return arrays[ALONE]
