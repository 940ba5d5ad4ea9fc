"""Compare a board's results with golden vectors: the first layer that differs, by how much, and
where.

The results are files with the golden vectors' names, in folders with their cases' names, as many as
the board can return. docs/how-to/board.md explains what a pattern usually means.
"""

import os
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from beers_deploy.kit.golden import INDEX, PICTURE, Golden, files_of, read_array, read_golden
from beers_deploy.profiles.errors import ImageError, OptionError, counted
from beers_deploy.profiles.figures import Check, Row, measured
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.graph import PLANES
from beers_deploy.results import Table

Errors = Mapping[str, list[np.ndarray]]
"""The absolute differences (N, C, H, W) of a board's results from the golden values, by tensor in
the order in which they are computed, with one array for each case.
"""


def compare_golden(folder: str | os.PathLike[str], results: str | os.PathLike[str]) -> Table:
    """Compare the results of a board with golden vectors, layer by layer.

    Args:
        folder: the folder that `write_golden` wrote.
        results: a folder of the board's tensors with the same names, CASE/LAYER.npy; some of them
            suffice. Values are int8, uint8 around 128, or float multiples of the tensor's scale,
            with the channels first or last.

    Returns:
        A row for each layer that was compared: the share of values that differ, the largest
        difference, and where they lie. The table is false if a layer differs.

    Raises:
        OptionError: a file has another name than the golden vectors, or there is none; or the
            golden vectors are damaged.
        ImageError: a file does not hold int8 values of the expected shape.
    """
    golden = read_golden(Path(folder))
    results_folder = Path(results)
    outputs = _errors(golden, results_folder)
    rows = []
    for name, errors in outputs.items():
        values = sum(error.size for error in errors)
        source = f"{counted(len(errors), 'case')}, {values} values, against the integer reference"
        differing = 100 * sum(map(np.count_nonzero, errors)) / values
        largest = max(int(error.max()) for error in errors)
        figures = {
            "differing": measured(differing, "%", source),
            "at most by": measured(largest, "LSB", source),
        }
        worst = max(errors, key=np.count_nonzero)
        rows.append(Row("golden", _layer(golden.core, name), figures, {"where": where(worst > 0)}))
    wrong = [name for name, errors in outputs.items() if any(error.any() for error in errors)]
    detail = ""
    if wrong:
        first, *_ = wrong
        detail = f"the first to differ is {_layer(golden.core, first)}"
        needed = {first}
        unseen = 0
        # Go back from the last operation until every path ends at a tensor that was returned.
        for op in reversed(golden.core.ops):
            if op.output in needed and op.output not in outputs.keys() - {first}:
                needed |= set(op.inputs)
                unseen += op.output != first
        if unseen:
            detail += f", {counted(unseen, 'layer')} before it not handed out"
    return Table(
        title=f"{results_folder.name} against {Path(folder).name}",
        inputs=(golden.network, Path(folder) / INDEX),
        rows=tuple(rows),
        checks=(Check("layers that differ", len(wrong), 0, "layer", detail=detail),),
        notes=() if wrong else (f"no layer differs: {len(rows)} compared",),
        headings={"golden": "layers"},
    )


def _errors(golden: Golden, folder: Path) -> Errors:
    """Read the results of a board, and return their differences from the golden values. Raise
    OptionError for a file that is not a result.
    """
    if not folder.is_dir():
        raise OptionError(f"{folder} is not a folder of a board's results. Check the path.")
    files = files_of(golden.core)
    paths = [path for path in folder.glob("*/*.npy") if path.name != PICTURE]
    unknown = [
        f"{path.parent.name}/{path.name}"
        for path in paths
        if path.parent.name not in golden.cases or path.name not in files.values()
    ]
    if unknown or not paths:
        raise OptionError(
            f"The results in {folder} must be named CASE/LAYER.npy as in {INDEX}, got "
            f"{(unknown or ['none'])[0]}. Rename them."
        )
    errors = defaultdict[str, list[np.ndarray]](list)
    for name, file in files.items():
        for path in sorted(folder.glob(f"*/{file}")):
            expected = golden.cases[path.parent.name][name]
            values = _integers(path, expected.shape, golden.core.frac_bits[name])
            # Differences of uint8 or int8 would wrap around, so the values are int16.
            errors[name].append(np.abs(values - expected))
    return errors


def _integers(path: Path, shape: tuple[int, ...], frac_bits: int) -> np.ndarray:
    """Read a tensor that a board wrote, as int16 (N, C, H, W)."""
    read = read_array(path)
    channels_last = read.shape != shape and read.ndim == len(shape)
    values = np.moveaxis(read, -1, 1) if channels_last else read
    if values.shape != shape:
        raise ImageError(
            f"{path} must have the shape {shape}, got {read.shape}. Write the whole tensor, for "
            "the tile of the golden vectors."
        )
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise ImageError(
            f"{path} must hold finite real numbers, but it holds {values.dtype} values or some "
            "that are not finite. Write int8."
        )
    numbers = values.astype(np.float64)
    if values.dtype == np.uint8:
        numbers -= 128
    elif values.dtype.kind == "f":
        numbers *= 2.0**frac_bits
    if (
        not (np.abs(numbers - np.rint(numbers)) < 1e-3).all()
        or np.abs(numbers).max(initial=0) > 128
    ):
        raise ImageError(
            f"{path} holds {values.dtype} numbers that are not those of an int8 tensor. Write "
            f"int8, or its values as integer multiples of 2^{-frac_bits}."
        )
    return np.rint(numbers).astype(np.int16)


def _layer(core: IntCore, name: str) -> str:
    """Return the name of the operation that writes a tensor."""
    return next((op.name for op in core.ops if op.output == name), PLANES)


def where(differs: np.ndarray) -> str:
    """Describe where wrong values lie, because the pattern hints at the cause.

    Args:
        differs: True for each value that differs, (N, C, H, W).

    Returns:
        Words such as "within 2 px of the border, in channel 3": the border, some rows or columns,
        or everywhere, and the channels. The text is empty if nothing differs.
    """
    if not differs.any():
        return ""
    height, width = differs.shape[2:]
    channels, rows, columns = (
        np.flatnonzero(np.moveaxis(differs, axis, 0).any((1, 2, 3))) for axis in (1, 2, 3)
    )
    within = f"{len(channels)} of {differs.shape[1]} channels"
    if len(channels) == 1:
        within = f"channel {channels[0]}"
    places = np.argwhere(differs.any((0, 1)))
    # The distance of the innermost difference from the nearest border.
    reach_px = int(np.minimum(places, np.array([height - 1, width - 1]) - places).min(1).max()) + 1
    if reach_px < min(height, width) // 4:
        return f"within {reach_px} px of the border, in {within}"
    for name, lines, size in (("row", rows, height), ("column", columns, width)):
        if len(lines) <= size // 4:
            span = f"{name}s {lines[0]} to {lines[-1]}"
            if len(lines) == 1:
                span = f"{name} {lines[0]}"
            return f"in {span}, in {within}"
    return f"everywhere, in {within}"
