"""A swath on a board or on all, predicted, beside the traditional pipeline on the board's processor
and the paper's.

One configuration and one tile size are predicted layer by layer; several are swept. Networks that
cannot be tiled are predicted by the frame.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from beers_deploy.bench.swath import PAPER_SIZE, Swath, parse_size, predict_network
from beers_deploy.bench.tables import (
    PAPER_TARGET,
    frame_row,
    host_words,
    layer_rows,
    predicted_rows,
    processor_row,
    published_rows,
    swath_row,
    sweep_rows,
    within_words,
)
from beers_deploy.dpu.board import ALL, BoardLike, Dpu, boards_of, dpu_of
from beers_deploy.dpu.cost.latency import Prediction
from beers_deploy.dpu.cost.model import TASKS, Task
from beers_deploy.dpu.cost.own_runs import read_own_runs
from beers_deploy.dpu.reading import own_tile_px
from beers_deploy.model.exposure import factors_for
from beers_deploy.model.raster.images import read_acquisition
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import MAX_DN, Sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, TILE_PX, require_side
from beers_deploy.restoration.options import parse_halo
from beers_deploy.restoration.plan import make_plan
from beers_deploy.restoration.steps import keeps_pixels, offset_of
from beers_deploy.restoration.tiles.exposures import tiles_by_factor
from beers_deploy.results import Table

FACE = {"throughput": "fps", "latency": "swath"}
"""What `predict` calls the figures of its rows."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Predicted(Table):
    """A network's speed, power and energy on boards, each figure with its interval: a row a
    configuration.

    Attributes:
        layers: where the time goes, layer by layer, of one configuration; empty of several.
    """

    layers: Table


def predict(
    network: NetworkLike,
    board: BoardLike | Sequence[BoardLike] = DEFAULT_TARGET,
    *,
    size: tuple[int, int] | str = PAPER_SIZE,
    dpu: str | None = None,
    tile: int = TILE_PX,
    halo: int | str = "exact",
    host_task: Task | None = None,
    measured: str | os.PathLike[str] | None = None,
    consistency: bool = True,
) -> Predicted:
    """Predict a network on boards by the cost model; nothing is measured.

    A network that cannot be tiled is predicted by the frame: then there is no swath, power nor
    energy of one.

    Args:
        network: float or INT8.
        board: one, several, or "all" of the shipped ones.
        size: (width, height) of the swath in pixels, or as text.
        dpu: configuration of the DPU, "all" of the board's, or None for the board's own.
        tile: side of a tile in pixels.
        halo: context around a tile in pixels; "exact" leaves no seams.
        host_task: what the host does with the results; None for what the file tells.
        measured: runs of the user's own board as JSON, by which the cost model is corrected.
        consistency: whether the host takes the consistency step.

    Raises:
        ModelError: no network, or one that does not run on the DPU.
        ProfileError: no such board or configuration.
        OptionError: options that do not go together.

    Examples:
        >>> found = bd.predict("convbeers-xs-int8", ["kv260", "vck190"], size=(4000, 3000))
        >>> slow, fast = (row.figures["fps"].value for row in found.rows)
        >>> slow < fast
        True
    """
    require_side(tile)
    if host_task not in (None, *TASKS):
        expected = f"one of {', '.join(TASKS)}, or None"
        raise OptionError("host_task", expected=expected, got=repr(host_task), remedy="choose one")
    source = Network.load(network, sensor=SENSOR, to_run=False)
    boards, corrected = _boards(board, dpu, None if measured is None else Path(measured))
    width_px, height_px = parse_size(
        "x".join(map(str, size)) if isinstance(size, tuple | list) else str(size)
    )
    try:
        tiling = source.tiling
    except ModelError:
        predictions, notes = _predictions(source, boards, tile, host_task)
        rows = list(map(frame_row, predictions))
    else:
        halo_px = parse_halo(str(halo), tiling.halo_px)
        takes_step = consistency and keeps_pixels(tiling)
        swath = Swath(width_px, height_px, tile, halo_px, consistency=takes_step)
        predictions, notes = _predictions(source, boards, tile, host_task, swath.step_px)
        rows = [swath_row(prediction, swath) for prediction in predictions]
    layers = layer_rows(predictions[0]) if len(boards) == 1 else []
    names = ", ".join(build.target.name for build in boards)
    arguments: dict[str, object] = {
        "target": names,
        "dpu": dpu,
        "size": f"{width_px}x{height_px}",
        "tile": tile,
        "halo": halo,
        "measured": measured,
        "host_task": host_task,
    }
    table_rows = list(chain.from_iterable(part for _, part in corrected))
    table_rows += [
        replace(row, figures={FACE.get(key, key): figure for key, figure in row.figures.items()})
        for row in rows
    ]
    about = ("predict", arguments, (source.input,))
    return Predicted(
        *about, tuple(table_rows), notes=tuple(notes), layers=Table(*about, tuple(layers))
    )


def _predictions(
    network: Network,
    boards: Sequence[Dpu],
    tile_px: int,
    task: Task | None,
    step_px: float = 0.0,
) -> tuple[list[Prediction], list[str]]:
    """A network on each board, of its own size where it is fixed to one; and what to say of its
    host.
    """
    # A network that is fixed to one size runs at that size alone.
    size_px = None if own_tile_px(network.model) else tile_px
    predictions = [predict_network(network, dpu, size_px, task, step_px) for dpu in boards]
    # Boards of one kind say the same of their hosts: each sentence is kept once.
    sentences = dict.fromkeys(chain.from_iterable(map(host_words, predictions)))
    return predictions, list(sentences)


TRAFFIC = (
    "LdFM, StFM: feature maps loaded and stored, an image; LdWB: weights and biases loaded, a batch"
)
Tables = list[tuple[str, list[Row]]]
"""Rows by the title of their table."""


@dataclass(frozen=True)
class BoardBench:
    """What was found.

    Attributes:
        shown: tables that answer, in their order.
        notes: sentences to say with them.
        layers: tables that say where the time goes, layer by layer.
        swath: the image that the rows are about; None of a network that is not tiled.
        dn: the image's digital numbers; None for a drawn one.
    """

    shown: Tables
    notes: list[str]
    layers: Tables = field(default_factory=list)
    swath: Swath | None = None
    dn: np.ndarray | None = None

    @property
    def rows(self) -> list[Row]:
        """All of them, those of the swath first."""
        tables = (*reversed(self.shown), *self.layers)
        return list(chain.from_iterable(part for _, part in tables))


def bench_board(
    network: NetworkLike,
    target: str,
    *,
    image: Path | None = None,
    full_scale: float | None = None,
    size: str | None = None,
    tiles_px: Sequence[int] = (TILE_PX,),
    halo: str = "exact",
    config: str | None = None,
    measured: Path | None = None,
    within_s: float | None = None,
    host_task: Task | None = None,
    sensor: Sensor | None = None,
    consistency: bool = True,
) -> BoardBench:
    """Predict a network's swath on boards; nothing is measured.

    A network that cannot be tiled is predicted by the frame, with nothing beside it.

    Args:
        network: what `Network.load` takes.
        target: the board, or "all".
        image: the swath; None for a drawn one of `size`.
        full_scale: the image's pixel value that is full scale; None lets its type and values
            decide.
        size: WIDTHxHEIGHT in pixels; None for the paper's.
        tiles_px: tile sides.
        halo: "exact" or a number of pixels.
        config: the DPU's configuration, "all", or None for the target's own.
        measured: runs of the user's board, by which the cost model is corrected.
        within_s: what the swath may take; None does not ask.
        host_task: what the host does with the results; None for what the file tells.
        sensor: that a shipped network is conditioned on: the exposures of `image` are counted; None
            counts none.
        consistency: whether the host takes the consistency step.
    """
    source = Network.load(network)
    boards, corrected = _boards(target, config, measured)
    try:
        tiling = source.tiling
    except ModelError as error:
        if image or size or within_s is not None:
            raise
        return _frames(source, boards, corrected, error, host_task)
    dn = read_acquisition(image, full_scale, None) if image else None
    width_px, height_px = (
        (dn.shape[1], dn.shape[0]) if dn is not None else parse_size(size or PAPER_SIZE)
    )
    halo_px = parse_halo(halo, tiling.halo_px)
    takes_step = consistency and keeps_pixels(tiling)
    swath = Swath(width_px, height_px, tiles_px[0], halo_px, consistency=takes_step)
    counts = dict[int, int]()
    if dn is not None and sensor is not None:
        plan = make_plan((1, height_px, width_px), tiles_px[0], halo_px, tiling)
        # `dn` is in 0..MAX_DN whatever the bits of the sensor.
        counts = tiles_by_factor(
            dn, plan, factors_for(sensor.nominal()), MAX_DN, offset_of(sensor, MAX_DN)
        )
        # A tile with bright and dark pixels runs once for each exposure that its pixels ask for.
        swath = replace(swath, runs=sum(counts.values()) / plan.tiles)
    targets = list({dpu.target.name: dpu.target for dpu in boards}.values())
    # The paper measured the VCK190 alone: its rows belong next to no other board.
    papers = published_rows() if any(profile.name == PAPER_TARGET for profile in targets) else []
    comparison = [*(processor_row(swath, profile) for profile in targets), *papers]
    title = f"{width_px} x {height_px} pixels"
    if len(boards) == len(tiles_px) == 1 and within_s is None:
        prediction = predict_network(source, boards[0], swath.tile_px, host_task, swath.step_px)
        rows = [*predicted_rows(source.name, prediction, swath), *comparison]
        tables = [*corrected, (f"{title} in tiles of {swath.tile_px}", rows)]
        notes = [*host_words(prediction), *exposure_words(counts)]
        layers = [_layers(source, prediction)]
        return BoardBench(tables, notes, layers, swath, dn)
    swept = sweep_rows(source, swath, boards, tiles_px, host_task)
    sweep = (f"{source.input.name}, {title} in whole tiles, halo {swath.halo_px} px", swept)
    tables = [*corrected, sweep, (f"{title}, for comparison", comparison)]
    notes = exposure_words(counts)
    if within_s is not None:
        notes.append(within_words(swept, boards, within_s))
    return BoardBench(tables, notes, [], swath, dn)


def exposure_words(counts: Mapping[int, int]) -> list[str]:
    """Say which share of an image's tiles asks for each exposure; nothing without counts."""
    if len(counts) < 2:
        return []
    total = sum(counts.values())
    shares = ", ".join(f"x{factor} {count / total:.0%}" for factor, count in counts.items())
    return [
        (
            f"runs of the network by exposure (measured on the image's pixels): {shares}; one tile "
            "may need several"
        )
    ]


def _layers(network: Network, prediction: Prediction) -> tuple[str, list[Row]]:
    dpu = prediction.dpu
    title = f"{network.input.name}, one batch on {dpu.target.name} {dpu.name}; {TRAFFIC}"
    return title, layer_rows(prediction)


def _frames(
    network: Network,
    boards: Sequence[Dpu],
    corrected: Tables,
    why: ModelError,
    task: Task | None,
) -> BoardBench:
    """The network on whole images; of one configuration each layer too."""
    predictions, notes = _predictions(network, boards, TILE_PX, task)
    rows = list(map(frame_row, predictions))
    sides = network.model.graph.input[0].type.tensor_type.shape.dim[2:]
    size = " x ".join(str(side.dim_value or TILE_PX) for side in sides)
    layers = [_layers(network, predictions[0])] if len(boards) == 1 else []
    reason = f"not tiled, but run on whole images: expected {why.expected}, got {why.got}"
    return BoardBench(
        [*corrected, (f"{network.input.name}, frames of {size}", rows)], [reason, *notes], layers
    )


def _boards(
    target: BoardLike | Sequence[BoardLike], config: str | None, measured: Path | None
) -> tuple[list[Dpu], Tables]:
    """The configurations asked for; corrected by runs where they are given, and the tables that say
    so.
    """
    if target == ALL and config not in (None, ALL):
        expected = "'all' or none beside all boards"
        remedy = "leave it out, or name the board"
        raise OptionError("dpu", expected=expected, got=repr(config), remedy=remedy)
    if target == ALL and measured is not None:
        expected = "one board beside `measured`"
        remedy = "name the board that the runs are of"
        raise OptionError("target", expected=expected, got=repr(target), remedy=remedy)
    targets = boards_of(target)
    boards = []
    for profile in targets:
        names = profile.configurations if config == ALL else [config]
        boards += [dpu_of(profile, name) for name in names]
    if measured is None:
        return boards, []
    own_runs = read_own_runs(measured, boards[0])
    tables = [(own_runs.source, own_runs.factor_rows()), ("your runs", own_runs.run_rows())]
    return [own_runs.applied(dpu) for dpu in boards], tables
