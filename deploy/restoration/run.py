"""One image file restored into another: what the command `restore` does with a network.

open -> settle runtime auto -> plan -> full scale -> open the network -> rows that a checkpoint lacks -> the TIFF
-> figures

One row is written while the next is made. Whatever stops a run, the output is the old one or the new one; finished
rows stay in the checkpoint where a later run can go on.
"""

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from itertools import count
from math import prod
from pathlib import Path

import numpy as np

from deploy.cluster import check_choice
from deploy.host_state import peak_memory
from deploy.restoration.bands import in_order, require_alike
from deploy.restoration.choice import require_one_process, settled
from deploy.restoration.cog import disk_bytes, require_cog, what_was_done, write_cog
from deploy.restoration.engine import RestoredRow, Restorer, Say, Tick, restore_rows
from deploy.restoration.georeference import enlarged_tags
from deploy.restoration.index_files import index_files
from deploy.restoration.options import Compression, Options
from deploy.restoration.output import (
    Checkpoint,
    only_run,
    part_folder,
    require_codec,
    require_tiff_name,
    write_output,
)
from deploy.restoration.plan import Plan, Span, check_memory, is_bulky, plan_for, rows_bytes
from deploy.restoration.radiometry import FullScale, full_scale_of
from deploy.restoration.runtime import open_runtime, tiles_at_once
from deploy.restoration.source import Source, fingerprint, open_source
from deploy.restoration.workers import make_work, rows_of_workers
from model.io.files import require_writable
from model.io.images import require_image_file
from model.processor import require_cores
from model.progress import held_back, steps
from profiles.errors import BeersError, ImageError, MachineError, OptionError
from profiles.figures import Figure, Row, measured, predicted, unavailable
from quant.onnx_file import load_onnx
from quant.reading.external import network_sha256

RUNS_UNTIL_STEADY = 2
"""Of each tile in work at a time: then a runtime takes no more memory."""
MANY = 0.05
"""Share of an image above its full scale that no scene has, but a wrong full scale."""
ARITHMETIC = "arithmetic on the plan of tiles"

Rows = Callable[[Sequence[Span], Tick], Generator[RestoredRow, None, None]]
"""Restores rows of tiles in order, here or by workers."""


def restore_file(image: Path, out: Path, options: Options, say: Say) -> Row:
    """Restore `image` into the TIFF `out`, and return the run's figures.

    Args:
        image: a TIFF of any size, a PNG, a JPEG, or what GDAL reads (deploy.restoration.source).
        out: a TIFF of the type `Raster.out_dtype`, in the scale of the image; larger by the network's
            factor where it has one, and in its place on Earth.
        options: what the user chose.
        say: told the plan, the memory, and how to go on after a stop.

    Raises:
        ImageError: no such image, damaged, all missing, or values outside 0 to full scale; nothing is left behind.
        ModelError: a network that cannot be tiled or run.
        OptionError: options that do not go together, or `resume` after a run of another kind.
        MachineError: another run on `out`; memory, disk, a package or lost workers: finished rows stay for `resume`.
        KeyboardInterrupt: stopped; rows already finished stay for `resume`.
    """
    check_choice(options.workers, options.scheduler)
    require_one_process(options)
    if options.bands and options.is_spread:
        got, remedy = "one for each band", "leave --workers and --scheduler out"
        raise OptionError("--sensor", expected="one sensor for workers", got=got, remedy=remedy)
    require_image_file(image)
    require_writable(out, inputs=(image, *index_files(image, options.trust_index), options.model))
    if options.scheduler is None:
        require_cores("--threads", options.threads)
    require_tiff_name(out)
    if options.cog:
        require_cog()
    else:
        require_codec(options.compression)
    with only_run(out, part_folder(out)):
        return _restore(image, out, options, say)


def _restore(image: Path, out: Path, options: Options, say: Say) -> Row:
    started = time.perf_counter()
    with open_source(image, options.trust_index) as source:
        raster = source.raster
        paths = in_order(options.bands, raster) if options.bands else [options.model]
        network, *others = networks = [load_onnx(path) for path in paths]
        require_alike(networks)
        options, chosen = settled(network, raster.shape, options, say)
        plan = plan_for(network, raster.shape, options)
        say(plan.sentence)
        if not options.is_spread:
            check_memory(rows_bytes(source, plan), options.memory_bytes, is_bulky(source, plan))
        scale = scale_of(source, plan, options, str(image))
        at_once = options.lanes or tiles_at_once(options.threads, plan.tiles)
        infer, runtime = open_runtime(options.runtime, network, options.threads, at_once)
        more = tuple(open_runtime(options.runtime, other, options.threads, at_once)[0] for other in others)
        restorer = Restorer(raster, infer, scale.value, plan.tiling, str(image), not scale.assumed, more)
        figures = {**chosen, **seam_figures(source, plan, restorer)}
        # Another version of the runtime might give other bits: rows of one are not finished by another.
        digests = ", ".join(network_sha256(path) for path in paths)
        job = _job(image, digests, plan, runtime, scale.value)
        cog_bytes = disk_bytes(plan.out_shape, raster.out_dtype.itemsize) if options.cog else 0
        checkpoint = Checkpoint(out, plan.out_shape, raster.out_dtype, job, options.resume, cog_bytes)
        done_rows = checkpoint.rows // plan.scale
        if options.is_spread:
            work, peaks_gb = make_work(image, plan, network, runtime, options, scale), list[float]()
            finish_rows(checkpoint, plan, str(image), say, partial(rows_of_workers, work, source, say, peaks_gb))
            figures |= worker_figures(peaks_gb)
        else:
            here = partial(_rows_here, source, plan, restorer, at_once, options.memory_bytes, say)
            finish_rows(checkpoint, plan, str(image), say, here)
    with held_back():  # a stop now would save nothing
        tags = enlarged_tags(raster.tags, plan.scale)
        if options.cog:
            about = what_was_done(networks, digests, scale)
            to_cog = partial(write_cog, compression=options.compression, about=about)
            write_output(checkpoint, tags, Compression.none, to_cog)
        else:
            write_output(checkpoint, tags, options.compression)
    time_s = time.perf_counter() - started
    if checkpoint.clipped:
        above = f"{checkpoint.clipped} pixels above full scale"
        share = checkpoint.clipped / prod(raster.shape)
        doubt = f": {share:.0%} of the image; is that its full scale?" if share > MANY else ""
        say(f"{above}, {scale.value:g} ({scale.source}), were clipped to it{doubt}")
    figures["clipped pixels"] = measured(checkpoint.clipped, "1", "pixels of the image above its full scale")
    return run_row(image.name, plan, done_rows, time_s, runtime, options, figures, scale)


def scale_of(source: Source, plan: Plan, options: Options, name: str) -> FullScale:
    """The pixel value that is full scale; float images are read to their first bright row of tiles to know it.

    Raises:
        ImageError: pixels that leave it open.
        OptionError: a full scale that such pixels cannot have.
    """
    largest = (source.raster.largest(source.read(row.keep_start, row.keep_stop)) for row in plan.rows)
    return full_scale_of(name, source.raster, largest, options.full_scale, options.sensor_bits)


def _job(image: Path, model: str, plan: Plan, runtime: str, full_scale: float) -> dict[str, object]:
    """All that decides the pixels, as the journal keeps it; who computes, on how many machines, is no part of it."""
    return {
        "image": [*fingerprint(image), image.stat().st_mtime_ns],
        "model": model,
        "tile_px": plan.tile_px,
        "halo_px": plan.halo_px,
        "full_scale": full_scale,
        "runtime": runtime,
    }


def finish_rows(checkpoint: Checkpoint, plan: Plan, name: str, say: Say, restored: Rows) -> None:
    """Restore the rows that a checkpoint lacks, and keep each in it while the next is made.

    Raises:
        ImageError: unreadable rows, values out of range, or no known pixel at all; the rows are thrown away.
        MachineError: memory, disk, or workers; finished rows stay.
        KeyboardInterrupt: stopped; finished rows stay.
    """
    rows = [row for row in plan.rows if row.keep_start * plan.scale >= checkpoint.rows]
    tiles = len(rows) * plan.row_tiles
    with _kept_for_resuming(checkpoint, say), steps("restoring", tiles) as bar, held_back() as interrupt:

        def tick(done: int) -> None:
            if done:
                bar.advance(done)
            if interrupt.asked:
                raise KeyboardInterrupt

        if rows:
            with closing(restored(rows, tick)) as finished:
                _write_behind(finished, checkpoint)
        if not checkpoint.known:
            got, remedy = "NaN or nodata everywhere", "check that it is the right file"
            raise ImageError(name, expected="some pixels with values", got=got, remedy=remedy)


@contextmanager
def _kept_for_resuming(checkpoint: Checkpoint, say: Say) -> Iterator[None]:
    """Finished rows outlive a stop and a full disk, not an image or a network that no later run could finish."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"stopped at row {checkpoint.rows} of {checkpoint.shape[1]}; the same command with --resume goes on")
        raise
    except BeersError as error:
        if not checkpoint.rows or not isinstance(error, MachineError):
            checkpoint.remove()
        raise


def _write_behind(restored: Iterable[RestoredRow], checkpoint: Checkpoint) -> None:
    """Keep rows, each while the next is made; never more than one waits."""
    with ThreadPoolExecutor(1) as writer:
        writing: Future[None] | None = None
        for row in restored:
            if writing is not None:
                writing.result()
            writing = writer.submit(checkpoint.append, row)
        if writing is not None:
            writing.result()


def _rows_here(
    source: Source,
    plan: Plan,
    restorer: Restorer,
    at_once: int,
    budget_bytes: int | None,
    say: Say,
    rows: Sequence[Span],
    tick: Tick,
) -> Generator[RestoredRow, None, None]:
    """Rows restored in this process, `at_once` tiles at a time; once the first tiles are done, memory is looked at.

    Raises:
        MachineError: the rows to come do not fit into memory.
    """
    tiles, steady = count(1), min(RUNS_UNTIL_STEADY * at_once, len(rows) * plan.row_tiles)

    def done() -> None:
        if next(tiles) == steady:
            needed = rows_bytes(source, plan, begun=True)
            most = check_memory(needed, budget_bytes, is_bulky(source, plan))
            say(f"memory: about {most / 1e9:.2f} GB (measured after the first tiles, and the rows to come)")
        tick(1)

    return restore_rows(source, plan, restorer, rows, done, at_once)


# The figures of a run.


def seam_figures(source: Source, plan: Plan, restorer: Restorer) -> dict[str, Figure]:
    """The error of seams, where the halo leaves any."""
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if plan.tiling.fixed_px is not None:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return {key: unavailable("DN", reason) for key in ("seam error max", "seam error mean")}
    largest, mean = seam_error_dn(source, plan, restorer)
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {"seam error max": measured(largest, "DN", how), "seam error mean": measured(mean, "DN", how)}


def seam_error_dn(source: Source, plan: Plan, restorer: Restorer) -> tuple[float, float]:
    """Largest and mean difference of a tile in the middle from the exact result, in digital numbers.

    The same kept pixels are restored twice: from the tile's own window, and from one with the whole radius around.
    """
    rows, columns = plan.rows[len(plan.rows) // 2], plan.columns[len(plan.columns) // 2]
    ends_px = plan.rows[-1].stop, plan.columns[-1].stop
    wide = [_widened(span, plan.radius_px, end_px) for span, end_px in zip((rows, columns), ends_px, strict=True)]
    start, stop = min(rows.start, wide[0].start), max(rows.stop, wide[0].stop)
    strip = restorer.read(source, start, stop)
    cheap, exact = (restorer.tile(strip, 0, *spans).pixels.astype(np.float64) for spans in ((rows, columns), wide))
    error = np.abs(np.nan_to_num(cheap) - np.nan_to_num(exact))
    return float(error.max()), float(error.mean())


def _widened(span: Span, radius_px: int, size_px: int) -> Span:
    """The same kept pixels with the whole radius around them, as far as the image goes, with its extension.

    What is kept ends on the network's lattice, or with the image: then what is read ends with the extension too.
    """
    start, stop = max(span.keep_start - radius_px, 0), min(span.keep_stop + radius_px, size_px)
    stop = size_px if span.stop == size_px else stop
    return Span(start, stop, span.keep_start, span.keep_stop)


def worker_figures(peaks_gb: Sequence[float]) -> dict[str, Figure]:
    """The memory of the worker that took most, of what each told with every row."""
    if not any(peaks_gb):
        return {"worker peak memory": unavailable("GB", "no row was left, or their system counts no peak memory")}
    how = "resident memory of the largest worker, highest since it began"
    return {"worker peak memory": measured(max(peaks_gb), "GB", how)}


def run_row(
    name: str,
    plan: Plan,
    done_rows: int,
    time_s: float,
    runtime: str,
    options: Options,
    more: dict[str, Figure],
    scale: FullScale,
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
    scales = {"full scale": f"{scale.value:g}", "full scale from": scale.source}
    text = {"halo": plan.halo_words, **scales, "runtime": runtime, **workers}
    return Row("restore", name, figures, text)
