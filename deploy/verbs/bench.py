"""`bench`: time, throughput, power and efficiency, predicted, measured and published."""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError, missing_extra
from beers_deploy.profiles.shipped import DEFAULT_TARGET, MODEL_SUFFIX, TILE_PX
from beers_deploy.verbs.parameters import (
    Halo,
    InputPath,
    Interval,
    NetworkLike,
    Progress,
    SensorLike,
    Size,
    Targets,
    Tiles,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.performance.board import Bench
    from beers_deploy.performance.swath import Swath
    from beers_deploy.profiles.sensor import Sensor

HOSTS = ("host", "host-cpu")
OF_BOARDS = [
    "image",
    "full_scale",
    "size",
    "halo",
    "dpu",
    "host_task",
    "measured",
    "traditional",
    "within",
    "consistency",
]
"""Parameters that count for what is predicted of a board."""
BUSY = 0.2
"""Share of this machine that others may take while something is measured, without a warning."""
NO_PROXY = "Time on this CPU is no proxy for the DPU: here INT8 may even run slower than float."


@verb
def bench(
    network: NetworkLike | None = None,
    *,
    target: Targets = f"{DEFAULT_TARGET}{MODEL_SUFFIX}",
    sensor: SensorLike = SENSOR,
    image: InputPath | None = None,
    full_scale: float | None = None,
    size: Size | None = None,
    tile: Tiles = TILE_PX,
    halo: Halo = "exact",
    dpu: str | None = None,
    host_task: Literal["copy", "argmax", "softmax", "sort", "image"] | None = None,
    measured: InputPath | None = None,
    traditional: bool = True,
    within: Annotated[float, Interval(ge=0)] | None = None,
    consistency: bool = True,
    threads: Annotated[int, Interval(ge=0)] = 0,
    progress: Progress = None,
) -> "Bench":
    """Predict a network on a DPU, next to the traditional pipeline and the paper's figures.

    The DPU's figures come from a cost model; the traditional pipeline is measured on crops on this
    machine. A network that cannot be tiled is predicted by the frame. -v adds the time of each
    layer.

    Args:
        network: ONNX network, or a shipped name, which stands for its INT8 file; convbeers-s-int8
            by default.
        target: board whose model predicts: name, also with -model behind it, or .toml file; several
            with commas, or all. An NPU has published figures only; 'host' measures on this machine.
        sensor: sensor of a shipped network: name, .toml file or blind.
        image: image of the swath, of one band and at most 12 bits, to count its exposures.
        full_scale: full scale of the image; 4095 by default.
        size: width x height of the swath in pixels; 13600x9016 by default.
        tile: side of a tile in pixels; several with commas are compared.
        halo: context around each tile in pixels, or 'exact' (no seams).
        dpu: configuration of the DPU, such as C32B3; all compares all of the board.
        host_task: work of the host on the results, if the file does not state it: argmax and
            softmax find the best class, sort finds boxes, image adds an image, copy reads only.
        measured: JSON list of runs on your board, which correct the cost model.
        traditional: measure the traditional pipeline on this machine, for some seconds.
        within: time in seconds that the swath may take; names the smallest DPU that is fast enough.
        consistency: count the consistency step on the board's processor.
        threads: threads of the host's runtime; 0 uses all cores.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of latency, throughput, power and efficiency. Its `layers` are those of one
        configuration.

    Raises:
        ModelError: no network, or one that does not run on the DPU.
        ProfileError: no such board or configuration.
        OptionError: options that do not go together.
        ImageError: an image that cannot be read.

    Examples:
        >>> table = bd.bench("convbeers-xs-int8", target="kv260,vck190", traditional=False)
        >>> slow, fast = (row.figures["throughput"].value for row in table.rows[:2])
        >>> slow < fast
        True
    """
    options = partial(changed, bench, locals())

    from beers_deploy.conditioned_file import conditioned_on
    from beers_deploy.dpu.board import boards_of
    from beers_deploy.model.raster.images import read_acquisition
    from beers_deploy.network import Network
    from beers_deploy.performance.board import Question, bench_board, boards_for, quoted
    from beers_deploy.performance.swath import parse_size
    from beers_deploy.performance.tables import parse_tiles
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.results import inputs_of, require_same

    if within == 0:
        raise OptionError("`within` must be above 0 s, got 0. Give the time that you have.")
    tiles_px = parse_tiles(tile)
    profile = Sensor.load(sensor)
    paths = [path_or_none(path) for path in (image, measured)]
    if target in HOSTS:
        refuse_with("`target` host", **options(*OF_BOARDS))
        return _on_this_machine(network, profile, tiles_px, threads)
    refuse_without("`target` host", **options("threads"))
    if image is None:
        refuse_without("`image`", **options("full_scale"))
    else:
        refuse_with("`image`", **options("size"))
    source = conditioned_on(Network.load(network, sensor=profile, int8=True), profile)
    # The digests are those of the files that are read from here on.
    inputs = inputs_of(*paths)
    boards = boards_of(target)
    # Next to other boards an NPU is refused below, because nothing can be predicted for it.
    if len(boards) == 1 and boards[0].npu:
        refuse_with(
            f"`target` {boards[0].name}, for which nothing is predicted", **options(*OF_BOARDS)
        )
        return quoted(source, boards[0])
    configurations, corrections = boards_for(boards, dpu, paths[1])
    asked = Question(
        configurations,
        corrections,
        None if size is None else parse_size(size),
        tiles_px,
        str(halo),
        within,
        host_task,
        consistency,
    )
    dn = None if paths[0] is None else read_acquisition(paths[0], full_scale, None)
    # Only a network that is conditioned on its sensor has exposures.
    table = bench_board(source, asked, dn, profile if source.weights else None)
    if traditional and table.swath is not None:
        table = _with_traditional(table, table.swath)
    require_same(inputs, *paths)
    return replace(table, inputs=(*table.inputs, *inputs))


def _on_this_machine(
    network: NetworkLike | None, sensor: "Sensor", tiles_px: list[int], threads: int
) -> "Bench":
    """Measure a network on this machine."""
    from beers_deploy.network import Network
    from beers_deploy.performance.board import Bench
    from beers_deploy.performance.host import host_rows
    from beers_deploy.profiles.target import TargetProfile

    if len(tiles_px) > 1:
        raise OptionError(
            f"`tile` must be one side with `target` host, got {len(tiles_px)}. Run it once for "
            "each side."
        )
    source = Network.load(network, sensor=sensor, int8=True)
    rows = host_rows(source, TargetProfile.load("host-cpu"), tiles_px[0], threads, sensor)
    return Bench(
        inputs=(source.input,),
        rows=tuple(rows),
        notes=(NO_PROXY,),
        headings={"host": f"{source.input.name} on this machine"},
    )


def _with_traditional(table: "Bench", swath: "Swath") -> "Bench":
    """Return a table with the traditional pipeline, measured on this machine."""
    try:
        from beers_deploy.performance.traditional import drawn_acquisition, measure_pipeline
    except ImportError as error:
        reason = missing_extra(error, "bench")
        note = f"The traditional pipeline is not measured here: {reason}"
        return replace(table, notes=(*table.notes, note))
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.profiles.shipped import REFERENCE

    sensors = Sensor.load(SENSOR), Sensor.load(REFERENCE)
    dn = drawn_acquisition(swath, *sensors) if table.dn is None else table.dn
    pipeline = measure_pipeline(dn, *sensors)
    headings = dict(table.headings)
    if pipeline.others > BUSY:
        first = table.rows[0].table
        headings[first] += (
            f". This machine is busy: other programs took {pipeline.others:.0%} of it while the "
            "traditional pipeline was measured, whose time is too long"
        )
    return replace(table, rows=(*table.rows, pipeline.row(swath)), headings=headings)
