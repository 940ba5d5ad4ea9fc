"""`quantize`: a float network to static INT8 under the rules of a DPU."""

import logging
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import ModelError, OptionError, counted, optional, printable
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    Holds,
    InputPath,
    InputRange,
    Interval,
    NetworkLike,
    OutputFile,
    OutputFolder,
    Progress,
    RequiredFile,
    Samples,
    Seed,
    SensorLike,
    Steps,
    TargetLike,
)
from beers_deploy.verbs.verb import (
    changed,
    path_or_none,
    recorded,
    refuse_with,
    refuse_without,
    verb,
)

if TYPE_CHECKING:
    from beers_deploy.network import Network
    from beers_deploy.profiles.figures import Row
    from beers_deploy.profiles.target import TargetProfile
    from beers_deploy.quant.samples.patches import Patches

logger = logging.getLogger(__name__)

PAGES = ("report.html", "report.json", "node-data.json")
"""The files that --report writes into its folder."""


@verb
def quantize(
    network: NetworkLike,
    *,
    out: RequiredFile | None = None,
    target: TargetLike = DEFAULT_TARGET,
    sensor: SensorLike = SENSOR,
    samples: Samples | None = None,
    input_range: InputRange | None = None,
    images: InputPath | None = None,
    patches: Annotated[int, Interval(ge=1, le=100_000)] = 64,
    patch: Annotated[int, Interval(ge=32, le=2048)] = 128,
    effort: Literal["fast", "normal", "best"] = "normal",
    finetune: Steps = 0,
    adapt: bool = False,
    output: str | None = None,
    seed: Seed = 0,
    board_file: OutputFile | None = None,
    tile: Annotated[int, Interval(ge=16, le=8192)] | None = None,
    report: Annotated[OutputFolder, Holds(*PAGES)] | None = None,
    progress: Progress = None,
) -> "Network":
    """Quantise a network to int8 with power-of-two scales.

    Any network that a DPU computes is accepted: see docs/reference/any-network.md, or ask 'check'.
    The table has the bits of each accumulator, measured and proven, and the share of saturated
    results. It also has what each restriction of the DPU costs, measured on samples that
    calibration did not see.

    Args:
        network: float ONNX or weights, or a shipped name. Weights of 'train --conditioned' are
            calibrated over the whole family of sensors.
        out: INT8 ONNX file to write, for any onnxruntime.
        target: board or NPU whose rules count: name or .toml file.
        sensor: sensor of the simulated patches, and of a network that is conditioned on one: name
            or .toml file.
        samples: your own samples in place of simulated patches: .npy or .npz (N, C, H, W), or a
            folder of images; in Python also arrays (N, C, H, W), two of them (images, references),
            or an iterable of these such as a DataLoader.
        input_range: LOW,HIGH of the values that the network reads, or such a pair for each channel,
            as 0,1,0,50; [0, 1] for channels whose samples lie in it, else what the samples span.
        images: folder of scenes to simulate from; drawn scenes by default.
        patches: number of simulated patches.
        patch: side of a simulated patch in pixels.
        effort: how thoroughly channels are equalised: fast takes first guesses, normal searches
            groups of channels for a bounded time, best searches each channel without a bound.
        finetune: number of steps that train the integers on the patches; 'auto' trains for some
            minutes, as long as the error falls.
        adapt: replace operators that the DPU lacks, such as SiLU by HardSwish, and report the loss
            in float.
        output: name of the output to keep of a network that has several.
        seed: seed of every random draw.
        board_file: also write the core in the board's encoding: QDQ ONNX, of an NPU VINT8.
        tile: side of the tile in pixels that `board_file` is fixed to; an NPU needs one.
        report: folder for report.html and report.json with the layers and patches that err most,
            and node-data.json for Google's Model Explorer.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        The INT8 network. Its `origin` is the float one, its `table` has the integer layers.

    Raises:
        ModelError: an operation that the DPU does not compute, or weights of no sensible size.
        OptionError: options that do not go together, a target without DPU or NPU, or samples that
            the network needs.
        ImageError: samples that the network does not accept.
        ProfileError: no such board or sensor.

    Examples:
        >>> import torch
        >>> network = torch.nn.Conv2d(1, 1, 3, padding=1)
        >>> samples = np.random.default_rng(0).random((8, 1, 32, 32), np.float32)
        >>> network = bd.Network.load(network, example=(1, 1, 32, 32))
        >>> bd.quantize(network, samples=samples, target="zcu102").precision
        'int8'
    """
    given = dict(locals())
    options = partial(changed, quantize, given)

    from beers_deploy.comparison import Data
    from beers_deploy.kit.board_file import require_core_file, save_core
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.profiles.target import TargetProfile
    from beers_deploy.quant.encodings import read_core
    from beers_deploy.quant.onnx_file import require_onnx_name
    from beers_deploy.quant.passes.effort import Effort
    from beers_deploy.quantization import quantized
    from beers_deploy.results import Table

    if board_file is None:
        refuse_without("`board_file`", **options("tile"))
    if samples is None:
        refuse_without("`samples`", **options("input_range"))
    else:
        refuse_with("`samples`", **options("images", "patches", "patch", "seed"))
    board = TargetProfile.load(target)
    files = [path_or_none(path) for path in (out, board_file)]
    inputs = [Path(each) for each in (network, samples) if isinstance(each, str | os.PathLike)]
    pages = _report_files(report, network)
    require_onnx_name(*files)
    require_core_file(board, files[1], tile, inputs)
    scenes = path_or_none(images)
    data = Data(Sensor.load(sensor), samples, scenes, patches, seed, patch, input_range)
    result, held_out = quantized(network, data, board, finetune, Effort(effort), adapt, output)
    # All results are made and judged before the first file is written, so that an error leaves
    # none.
    core = result.core(board, tile) if files[1] else None
    _warn_of_refusals(result, board)
    notes = _notes(result, adapt)
    rows = list(result.layers)
    if held_out is not None:
        more, sentence = _judged(result, held_out, pages)
        rows = [*more, *rows]
        notes.append(sentence)
    if files[0] is not None:
        result.save(files[0])
        count = len(read_core(result.model).ops)
        logger.info("wrote %s: %s", files[0], counted(count, "integer operation"))
    if core is not None and files[1] is not None:
        save_core(core, files[1], board)
    assert result.origin is not None  # noqa: S101
    table = Table(
        command="quantize",
        arguments=recorded(
            {**given, "network": result.origin, "target": board, "sensor": data.sensor}
        ),
        title=f"{result.name}: each integer layer",
        inputs=(result.origin.input, *data.inputs),
        rows=tuple(rows),
        notes=tuple(notes),
        headings=HEADINGS,
        details=DETAILS,
    )
    if pages:
        table.save(pages[1])
    return replace(result, table=table)


HEADINGS = {
    "adapted": "operators that the DPU lacks, and what replacing them costs in float",
    "rounding": "tie rounding",
    "gate": "float against INT8, on patches that calibration did not see",
    "price": "what the DPU's restrictions cost, one more in each row",
}
DETAILS = frozenset(
    {
        "as onnxruntime",
        "at most by",
        "error sizes",
        "layers",
        "moved by half up",
        "rounding",
        "ties",
        "worst patches",
        "worst samples",
    }
)
"""Tables and figures for a closer look."""


def _notes(result: "Network", adapt: bool) -> list[str]:
    """Return notes on the calibration that the INT8 file records, and on use by `restore`."""
    from beers_deploy.quant.adapt.adaptation import ADAPTED
    from beers_deploy.quant.input_range import KEY
    from beers_deploy.quant.onnx_file import metadata
    from beers_deploy.quant.samples.coverage import recorded_range

    about = metadata(result.model)
    covered = recorded_range(about)
    notes = [] if covered is None else [f"calibration: {covered}"]
    if KEY in about:
        notes.append(f"input range: {about[KEY]}")
    if adapt and ADAPTED not in about:
        notes.append("`adapt` replaced nothing: the DPU computes all operators of the network")
    try:
        if reason := result.geometry.reads_whole:
            notes.append(
                "`restore` restores its tiles independently, with seams, and `bench` counts whole "
                f"images: {reason}"
            )
    except ModelError as error:
        notes.append(f"`restore` does not run it, and `bench` counts whole images: {error}")
    return notes


def _warn_of_refusals(result: "Network", board: "TargetProfile") -> None:
    """Warn if the board does not run the network. Other hardware may run it."""
    from beers_deploy.dpu.checker.table import check_network

    # For an NPU the file of the core is checked, which is fixed to a tile.
    checked = None if board.npu else check_network(result, board, None, None)
    if checked is not None and checked.failed:
        logger.warning("%s does not run it: %s", board.name, checked.verdict)


def _judged(network: "Network", held_out: "Patches", pages: list[Path]) -> "tuple[list[Row], str]":
    """Measure the change by INT8 on samples that calibration did not see: rows and a sentence.

    The rows state the price of each restriction of the DPU. With pages there are also rows of
    layers and of the worst samples, and all pages but report.json are written.
    """
    from beers_deploy.model.io.files import write_text
    from beers_deploy.quant.price import price_rows
    from beers_deploy.quant.sensitivity import losses
    from beers_deploy.quantization import differences_of, sensitivity_report
    from beers_deploy.report.page import write_report
    from beers_deploy.report.sensitivity_page import node_data

    assert network.quantized is not None  # noqa: S101 - it was quantised here
    differences = differences_of(network, held_out)
    prices = price_rows(network.quantized, held_out)
    rows: list[Row] = []
    if pages:
        rows, report = sensitivity_report(network, held_out, differences, prices)
        write_report(report, pages[0])
        logger.info("wrote %s: %s", pages[0], report.headline)
    layers = [row for row in rows if row.table == "layers"]
    if pages:
        write_text(pages[-1], node_data(layers))
    return [*rows, *prices], losses(network.quantized, differences, held_out, layers)


def _report_files(folder: OutputFolder | None, network: Any) -> list[Path]:
    """Return the page and the figures of --report, which matplotlib draws."""
    from beers_deploy.network_files import conditioned

    if folder is None:
        return []
    named = isinstance(network, str | os.PathLike)
    if named and conditioned(Path(network)):
        raise OptionError(
            f"`report` cannot be combined with {printable(str(network))}, because the network is "
            "calibrated over a family of sensors. Leave `report` out."
        )
    # A missing package is refused before the network is calibrated.
    optional("matplotlib", "report")
    return [Path(folder) / name for name in PAGES]
