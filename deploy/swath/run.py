"""One image file restored into another: what the command `restore` does."""

import time
from pathlib import Path

import onnx

from deploy.cluster import check_choice
from deploy.cores import require_cores
from deploy.restore import check_fixed_tile, parse_halo
from deploy.results import Row
from deploy.swath.figures import plan_sentence, run_row, seam_figures, worker_figures
from deploy.swath.fill import Say, fill_here
from deploy.swath.job import make_job
from deploy.swath.lock import only_run
from deploy.swath.memory import check_memory, is_bulky, rows_bytes
from deploy.swath.options import Options
from deploy.swath.plan import Plan, make_plan
from deploy.swath.raster import Raster
from deploy.swath.reader import Source, open_source
from deploy.swath.restorer import Restorer
from deploy.swath.runtime import open_runtime, tiles_at_once
from deploy.swath.spool import Spool, part_folder
from deploy.swath.spread import fill_spread, make_work
from deploy.swath.writer import require_codec, require_tiff_name, write_output
from model.files import require_writable
from model.scale import settled_scale
from model.training.interrupts import held_back
from quant.onnx_file import fixed_tile_px, load_onnx
from quant.radius import receptive_radius_px


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
    return make_plan(raster, options.tile_px, halo_px, radius_px, fixed)


def scale_of(source: Source, plan: Plan, asked: float | None, name: str) -> float:
    """The pixel value that is full scale; float images are read to their first bright row of tiles to know it.

    Raises:
        ImageError: pixels that leave it open.
        OptionError: a full scale that such pixels cannot have.
    """
    largest = (source.raster.largest(source.read(row.keep_start, row.keep_stop)) for row in plan.rows)
    return settled_scale(name, source.raster.dtype, largest, asked)
