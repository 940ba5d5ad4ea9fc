"""A swath on boards, predicted, next to the traditional pipeline on the board's processor and the
paper's figures.

One configuration and one tile size are predicted layer by layer; several are swept. Networks that
cannot be tiled are predicted by the frame.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy.dpu.board import ALL, Dpu, dpu_of
from beers_deploy.dpu.cost.host import Task
from beers_deploy.dpu.cost.latency import Prediction
from beers_deploy.dpu.cost.own_runs import read_own_runs
from beers_deploy.dpu.reading import own_tile_px
from beers_deploy.model.departure import has_other_curve
from beers_deploy.network import Network
from beers_deploy.performance.swath import (
    PAPER_SIZE,
    Swath,
    exposed,
    parse_size,
    predict_network,
)
from beers_deploy.performance.tables import (
    LAYERS,
    PAPER_TARGET,
    TABLE,
    frame_row,
    host_words,
    layer_rows,
    named,
    predicted_rows,
    processor_row,
    published_rows,
    sweep_rows,
    within_words,
)
from beers_deploy.profiles.errors import ModelError, OptionError, printable
from beers_deploy.profiles.figures import Row, published, unavailable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.plan import parse_halo
from beers_deploy.restoration.steps import keeps_pixels
from beers_deploy.results import Table

Tables = list[tuple[str, list[Row]]]
"""Rows by the title of their table."""


TRAFFIC = (
    "LdFM, StFM: feature maps loaded and stored, an image; LdWB: weights and biases loaded, a batch"
)
NO_BOARD = "No board was used: the DPU's figures come from a cost model."
CORRECTED = "The DPU's figures come from a cost model, corrected by your runs on the board."
POWER = (
    "Its power is not predictable from public data: it is the range of what is published of the "
    "board, for any network."
)
DETAILS = frozenset(
    {
        "CPU load",
        "batch",
        "bound",
        "consistency step",
        "energy",
        "fitted range",
        "host next to the DPU",
        "host's task",
        "layers",
        "layers on chip",
        "maps through memory",
        "network runs",
        "one-thread latency",
        "threads",
        "tiles",
        "time",
        "work",
        "work factor",
    }
)
"""Figures and tables for a closer look."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Bench(Table):
    """The result of `bench`: speed, power and energy of a network and of the traditional pipeline.

    Attributes:
        swath: the image that the rows describe and its tiles; None for a network that runs on whole
            images, or for times on this machine.
        dn: digital numbers (H, W) of the image that the user gave; None without one.
    """

    swath: Swath | None = None
    dn: np.ndarray | None = field(default=None, compare=False)

    @property
    def layers(self) -> list[Row]:
        """The rows of the table of layers, with the time of each layer on the DPU.

        The list is empty unless exactly one configuration of one board was predicted.
        """
        return [row for row in self.rows if row.table == LAYERS]


@dataclass(frozen=True)
class Question:
    """The options of `bench` for a prediction by the cost model.

    A swath is the long image that a satellite takes along its track.

    Attributes:
        boards: the DPU configurations to predict, of one or several boards.
        corrections: titles and rows of tables that show how the user's measured runs correct the
            cost model; empty without such runs.
        size: (width, height) of the swath in pixels; None for the paper's, or that of the image.
        tiles_px: the sides in pixels of the tiles to predict.
        halo: the pixels around a tile that are computed and discarded: "exact" for as many as the
            network needs to leave no seams, or a number.
        within_s: the time limit of the swath in s; None for no limit.
        task: the host's task with the results; None derives it from the network's operators.
        consistency: True if the host computes the consistency step, which makes block means of the
            result agree with the raw image.
    """

    boards: Sequence[Dpu]
    corrections: Tables
    size: tuple[int, int] | None
    tiles_px: Sequence[int]
    halo: str
    within_s: float | None
    task: Task | None
    consistency: bool


def bench_board(
    network: Network, asked: Question, dn: np.ndarray | None = None, sensor: Sensor | None = None
) -> Bench:
    """Predict the time of a swath on boards. Nothing is measured.

    A network that cannot be tiled is predicted per frame, without a swath.

    Args:
        network: the network, in float or INT8.
        asked: the options: boards, tiles and swath.
        dn: digital numbers (H, W) of an image to use as the swath; None for a swath of which only
            the size is known.
        sensor: the sensor that a shipped network is conditioned on. With it and `dn`, tiles count
            once for each exposure (factor of brightness) that their pixels need. None counts each
            tile once.

    Returns:
        The table of `bench`.

    Raises:
        ModelError: the network does not run on the DPU, or it cannot be tiled although a size, an
            image or a time is requested.
    """
    try:
        tiling = network.tiling
    except ModelError as error:
        # First, so that the remedy below works.
        frames = _frames(network, asked, error)
        of_swaths = {"image": dn, "size": asked.size, "within": asked.within_s}
        given = [f"`{name}`" for name, value in of_swaths.items() if value is not None]
        if not given:
            return frames
        raise ModelError(
            f"{error} To predict the network by the frame, leave out {' and '.join(given)}."
        ) from error
    swaths = [_swath(asked, tiling, tile_px, dn, sensor) for tile_px in asked.tiles_px]
    notes = list[str]()
    if dn is not None and sensor is not None:
        for number, whole in enumerate(swaths):
            swaths[number], words = exposed(whole, dn, sensor, tiling)
            notes += words
    swath = swaths[0]
    targets = list({dpu.target.name: dpu.target for dpu in asked.boards}.values())
    # The paper measured the VCK190 alone: its rows belong next to no other board.
    papers = published_rows() if any(profile.name == PAPER_TARGET for profile in targets) else []
    comparison = [*(processor_row(swath, profile) for profile in targets), *papers]
    bands = f" of {swath.bands} bands" if swath.bands > 1 else ""
    title = f"{swath.width_px} x {swath.height_px} pixels{bands}"
    if len(asked.boards) == len(asked.tiles_px) == 1 and asked.within_s is None:
        (dpu,) = asked.boards
        prediction = predict_network(network, dpu, swath.tile_px, asked.task, swath.step_px)
        rows = [*predicted_rows(network.name, prediction, swath), *comparison]
        tables = [(f"{title} in tiles of {swath.tile_px}", rows), *asked.corrections]
        tables.append(_layers(network, prediction))
        notes = [*host_words(prediction), *notes]
    else:
        rows = sweep_rows(network, swaths, asked.boards, asked.task)
        if papers:
            comparison += _counted_alike(network, asked, swath)
        sweep = f"{network.input.name}, {title} in whole tiles, halo {swath.halo_px} px"
        tables = [(sweep, rows), (f"{title}, for comparison", comparison), *asked.corrections]
    if asked.within_s is not None:
        notes.append(within_words(rows, asked.boards, asked.within_s))
    return _table(network, asked.boards, tables, [*fitted_words(rows), *notes], swath=swath, dn=dn)


def _swath(
    asked: Question, tiling: Tiling, tile_px: int, dn: np.ndarray | None, sensor: Sensor | None
) -> Swath:
    """Return the swath in tiles of one size, of which each runs once."""
    width_px, height_px = asked.size or parse_size(PAPER_SIZE)
    if dn is not None:
        height_px, width_px = dn.shape
    restores = keeps_pixels(tiling)
    return Swath(
        width_px,
        height_px,
        tile_px,
        parse_halo(asked.halo, tiling.halo_px),
        bands=tiling.channels_out if restores else 1,
        consistency=asked.consistency and restores,
        detail=sensor is not None and has_other_curve(sensor.nominal()),
    )


def _counted_alike(network: Network, asked: Question, swath: Swath) -> list[Row]:
    """Predict the swath in tiles as the paper counts them, for comparison with the paper's run.

    Whole tiles with a halo are more work than the paper counts, so their time is not comparable.
    """
    boards = [dpu for dpu in asked.boards if dpu.target.name == PAPER_TARGET]
    default = (dpu for dpu in boards if dpu.name == dpu.target.default_configuration)
    dpu = next(default, boards[0])
    prediction = predict_network(network, dpu, swath.tile_px, asked.task, swath.step_px)
    return predicted_rows(network.name, prediction, swath)[:1]


def _table(
    network: Network, boards: Sequence[Dpu], tables: Tables, notes: Sequence[str], **more: Any
) -> Bench:
    """Join tables with titles to the one table that `bench` returns."""
    rows = list(chain.from_iterable(part for _, part in tables))
    headings = {part[0].table: title for title, part in tables if part}
    errors = {dpu.target.name: dpu.value("cost", "error_left_out") for dpu in boards}
    for name, error in errors.items():
        # Such a board's cost model is fitted to few published rates.
        if error > POOR:
            headings[rows[0].table] += (
                f". Of {name} little is known: networks left out of the fit are off by {error:.0%}"
            )
    return Bench(
        inputs=(network.input,),
        rows=tuple(rows),
        notes=(*notes, f"{CORRECTED if boards[0].runs else NO_BOARD} {POWER}"),
        headings=headings,
        details=DETAILS,
        **more,
    )


POOR = 0.15
"""Mean error of networks left out of a board's fit from which the first line of a table warns."""


def fitted_words(rows: Sequence[Row]) -> list[str]:
    """Warn of predictions outside the range of the networks that the cost model was fitted to.

    Args:
        rows: rows of predictions, whose text "fitted range" is "inside" or says what is outside.

    Returns:
        A sentence for each text other than "inside", with the names of its rows.
    """
    ranges = defaultdict[str, list[str]](list)
    for row in rows:
        ranges[row.text.get("fitted range", "inside")].append(row.name)
    ranges.pop("inside", None)
    return [f"fitted range of {'; '.join(names)}: {words}" for words, names in ranges.items()]


def _layers(network: Network, prediction: Prediction) -> tuple[str, list[Row]]:
    title = f"{network.input.name}, one batch on {named(prediction.dpu)}; {TRAFFIC}"
    return title, layer_rows(prediction)


def _frames(network: Network, asked: Question, why: ModelError) -> Bench:
    """Predict a network that runs on whole images. For one configuration, list each layer too."""
    # A network that is fixed to one size runs at that size alone.
    size_px = None if own_tile_px(network.model) else TILE_PX
    predictions = [predict_network(network, dpu, size_px, asked.task) for dpu in asked.boards]
    # Boards of one kind say the same of their hosts: each sentence is printed once.
    notes = dict.fromkeys(chain.from_iterable(map(host_words, predictions)))
    rows = list(map(frame_row, predictions))
    sides = network.model.graph.input[0].type.tensor_type.shape.dim[2:]
    size = " x ".join(str(side.dim_value or TILE_PX) for side in sides)
    tables = [(f"{network.input.name}, frames of {size}", rows), *asked.corrections]
    if len(asked.boards) == 1:
        tables.append(_layers(network, predictions[0]))
    reason = f"The network runs on whole images. {why}"
    return _table(network, asked.boards, tables, [*fitted_words(rows), reason, *notes])


QUOTED = {"latency": "ms", "throughput": "fps"}
"""Name and unit of the figures in [published_latency_ms] and [published_throughput_fps]."""


def quoted(network: Network, target: TargetProfile) -> Bench:
    """Return published figures of other networks, for a board that the cost model cannot predict.

    Args:
        network: the network, whose own figures are reported as unavailable.
        target: a board for which too few rates are published to fit a cost model.
    """
    title = (
        f"{network.input.name} on {target.name}: nothing is predicted; other networks are published"
    )
    reason = f"too few rates of {target.name} are published to fit a cost model"
    figures = {key: unavailable(unit, reason) for key, unit in QUOTED.items()}
    figures["power"] = unavailable("W", f"no power of {target.name} is published")
    rows = [Row(TABLE, f"{network.name} on {target.name}", figures)]
    for key, unit in QUOTED.items():
        for name, constant in target.tables.get(f"published_{key}_{unit}", {}).items():
            figure = published(constant.low, unit, constant.source)
            rows.append(Row(TABLE, f"quoted: {name}", {key: figure}))
    return Bench(inputs=(network.input,), rows=tuple(rows), headings={TABLE: title})


def boards_for(
    targets: Sequence[TargetProfile], config: str | None, measured: Path | None
) -> tuple[list[Dpu], Tables]:
    """Select the DPU configurations that `bench` predicts, corrected by the user's measurements.

    Args:
        targets: the boards.
        config: the name of a configuration, "all" for all of each board, or None for the default.
        measured: a JSON file of runs that the user measured on the board; None without them.

    Returns:
        The configurations, and the titles and rows of tables that compare the runs with their
        predictions (empty without runs).

    Raises:
        OptionError: one configuration for all boards, or runs for several.
        ProfileError: no such board or configuration.
    """
    if len(targets) > 1 and config not in (None, ALL):
        raise OptionError(
            f"`dpu` {printable(repr(config))} cannot be combined with several boards. Name one "
            "board, or give 'all'."
        )
    if len(targets) > 1 and measured is not None:
        raise OptionError(
            "`measured` cannot be combined with several boards. Name the board of the runs with "
            "`target`."
        )
    boards = []
    for profile in targets:
        names = profile.configurations if config == ALL else [config]
        boards += [dpu_of(profile, name) for name in names]
    if measured is None:
        return boards, []
    own_runs = read_own_runs(measured, boards[0])
    tables = [(own_runs.source, own_runs.run_rows())]
    return [own_runs.applied(dpu) for dpu in boards], tables
