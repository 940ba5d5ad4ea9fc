"""One image file restored into another: what the command `restore` does."""

import time
from pathlib import Path

import onnx

from deploy.bench.host_state import peak_memory
from deploy.cluster import check_choice
from deploy.restoration.arrays import check_fixed_tile, parse_halo
from deploy.restoration.engine import Restorer, Say, fill_here, seam_error_dn
from deploy.restoration.options import Options, make_job
from deploy.restoration.output import Spool, only_run, part_folder, require_codec, require_tiff_name, write_output
from deploy.restoration.plan import Plan, check_memory, is_bulky, make_plan, rows_bytes
from deploy.restoration.runtime import open_runtime, tiles_at_once
from deploy.restoration.source import Raster, Source, open_source
from deploy.restoration.workers import fill_spread, make_work
from model.io.files import require_writable
from model.io.images import settled_scale
from model.processor import require_cores
from model.progress import held_back
from profiles.figures import Figure, Row, measured, predicted, unavailable
from quant.onnx_file import fixed_tile_px, load_onnx, receptive_radius_px

ARITHMETIC = "arithmetic on the plan of tiles"


def plan_sentence(plan: Plan) -> str:
    """How the image is cut."""
    bands = f", each of {plan.bands} bands by itself" if plan.bands > 1 else ""
    rows_px, columns_px = plan.tile_shape
    tiles = "1 tile" if plan.tiles == 1 else f"{plan.tiles} tiles"
    return (
        f"plan: {plan.width_px} x {plan.height_px} pixels{bands}; {tiles} of {columns_px} x {rows_px}, "
        f"halo {_halo(plan)}, work factor {plan.work_factor:.2f}"
    )


def seam_figures(source: Source, plan: Plan, restorer: Restorer, fixed: bool) -> dict[str, Figure]:
    """The error of seams, where the halo leaves any; `fixed`: the network takes one tile size only."""
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if fixed:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return {key: unavailable("DN", reason) for key in ("seam error max", "seam error mean")}
    largest, mean = seam_error_dn(source, plan, restorer)
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {"seam error max": measured(largest, "DN", how), "seam error mean": measured(mean, "DN", how)}


def worker_figures(peak_gb: float | None) -> dict[str, Figure]:
    """The memory of the worker that took most."""
    if peak_gb is None:
        return {"worker peak memory": unavailable("GB", "no row was left, or their system counts no peak memory")}
    how = "resident memory of the largest worker, highest since it began"
    return {"worker peak memory": measured(peak_gb, "GB", how)}


def run_row(
    name: str,
    plan: Plan,
    done_rows: int,
    time_s: float,
    runtime: str,
    options: Options,
    more: dict[str, Figure],
    full_scale: float,
) -> Row:
    """The figures of one run, of which `done_rows` were finished before."""
    useful_px = plan.bands * (plan.height_px - done_rows) * plan.width_px
    source = f"from opening the image to the finished file, {runtime}"
    figures = {
        "time": measured(time_s, "s", source),
        "throughput": measured(useful_px / time_s / 1e6, "Mpx/s", f"the image's own pixels, {source}"),
        "tiles": predicted(plan.tiles, "1", (plan.tiles, plan.tiles), ARITHMETIC),
        "work factor": predicted(plan.work_factor, "1", (plan.work_factor, plan.work_factor), ARITHMETIC),
        "peak memory": peak_memory(),
        **more,
    }
    workers = {"workers": options.scheduler or str(options.workers)} if options.is_spread else {}
    return Row(
        "restore",
        name,
        figures,
        {"halo": _halo(plan), "full scale": f"{full_scale:g}", "runtime": runtime, **workers},
    )


def _halo(plan: Plan) -> str:
    if plan.halo_px >= plan.radius_px:
        return f"{plan.halo_px} px (exact)"
    return f"{plan.halo_px} px (seams: exact is {plan.radius_px})"


def restore_file(image: Path, out: Path, options: Options, say: Say) -> Row:
    """Restore `image` into the TIFF `out`, and return the run's figures.

    Raises:
        ImageError: no such image, damaged, all missing, or values outside 0 to full scale; nothing is left behind.
        ModelError: a network that cannot be tiled or run.
        OptionError: options that do not go together, or `resume` after a run of another kind.
        MachineError: another run on `out`; memory, disk, a package or lost workers: finished rows stay for `resume`.
        KeyboardInterrupt: stopped; rows already finished stay for `resume`.
    """
    check_choice(options.workers, options.scheduler)
    require_writable(out, inputs=(image, options.model))
    if options.scheduler is None:
        require_cores("--threads", options.threads)
    require_tiff_name(out)
    require_codec(options.compression)
    with only_run(out, part_folder(out)):
        return _restore(image, out, options, say)


def _restore(image: Path, out: Path, options: Options, say: Say) -> Row:
    started = time.perf_counter()
    network = load_onnx(options.model)
    with open_source(image) as source:
        plan = plan_of(source.raster, network, options)
        say(plan_sentence(plan))
        if not options.is_spread:
            check_memory(rows_bytes(source, plan), options.memory_bytes, is_bulky(source, plan))
        full_scale = scale_of(source, plan, options.full_scale, str(image))
        at_once = tiles_at_once(options.threads, plan.tiles)
        infer, runtime = open_runtime(options.runtime, network, options.threads, at_once)
        restorer = Restorer(source.raster, infer, full_scale, plan.radius_px, str(image))
        figures = seam_figures(source, plan, restorer, fixed_tile_px(network) is not None)
        job = make_job(image, options, plan, runtime, full_scale)
        spool = Spool(out, source.raster.shape, source.raster.out_dtype, job, options.resume)
        done = spool.rows
        if options.is_spread:
            work = make_work(image, plan, network, runtime, options, full_scale)
            figures |= worker_figures(fill_spread(spool, source, work, say))
        else:
            fill_here(spool, source, plan, restorer, at_once, options.memory_bytes, say)
    with held_back():  # a stop now would save nothing
        write_output(spool, source.raster, options.compression)
    return run_row(image.name, plan, done, time.perf_counter() - started, runtime, options, figures, full_scale)


def plan_of(raster: Raster, network: onnx.ModelProto, options: Options) -> Plan:
    """How the image is cut for the network.

    Raises:
        ModelError: a network that cannot be tiled.
        OptionError: options that do not go together.
    """
    radius_px = receptive_radius_px(network)
    check_fixed_tile(network, options.tile_px, raster.shape[1:])
    halo_px, fixed = parse_halo(options.halo, radius_px), fixed_tile_px(network) is not None
    return make_plan(raster.shape, options.tile_px, halo_px, radius_px, fixed)


def scale_of(source: Source, plan: Plan, asked: float | None, name: str) -> float:
    """The pixel value that is full scale; float images are read to their first bright row of tiles to know it.

    Raises:
        ImageError: pixels that leave it open.
        OptionError: a full scale that such pixels cannot have.
    """
    largest = (source.raster.largest(source.read(row.keep_start, row.keep_stop)) for row in plan.rows)
    return settled_scale(name, source.raster.dtype, largest, asked)
