"""One image file restored into another: what the command `restore` does with a network.

open -> plan -> full scale -> open the network, here or on a cluster -> rows that a checkpoint lacks
-> the TIFF -> figures

One row is written while the next is made. Whatever stops a run, the output is the old one or the
new one; finished rows stay in the checkpoint where a later run can go on.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from importlib.metadata import version
from itertools import chain
from math import prod
from pathlib import Path

import numpy as np
import onnx

from beers_deploy.cluster import Cluster, open_cluster
from beers_deploy.host_state import peak_memory
from beers_deploy.model.io.files import require_writable
from beers_deploy.model.io.lock import only_run
from beers_deploy.model.processor import require_cores
from beers_deploy.model.progress import Log, held_back, no_log, steps
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.facts import require_raw
from beers_deploy.model.raster.reader import open_raster, require_image_file
from beers_deploy.model.raster.source import Source, fingerprint, stamps
from beers_deploy.model.raster.writer import cog_bytes, require_codec, write_cog
from beers_deploy.profiles.errors import BeersError, ImageError, MachineError
from beers_deploy.profiles.figures import Figure, Row, measured, predicted, unavailable
from beers_deploy.profiles.sensor import numbers_of
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.reading.external import network_sha256, unchanged
from beers_deploy.restoration.bands import in_order, require_alike
from beers_deploy.restoration.checkpoint import Checkpoint
from beers_deploy.restoration.detectors.fault_list import list_beside, write_list
from beers_deploy.restoration.detectors.fix import faults_of, fixed
from beers_deploy.restoration.detectors.words import warn_of_detectors
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.output import require_tiff_name, what_was_done, write_output
from beers_deploy.restoration.plan import Plan, Span, check_memory, is_bulky, plan_for, rows_bytes
from beers_deploy.restoration.radiometry import FullScale, full_scale_of
from beers_deploy.restoration.runtime import Infer, Packed, infer_on, open_runtime, tiles_at_once
from beers_deploy.restoration.sensor_check import SensorCheck, restored_already, told_sensor
from beers_deploy.restoration.steps import consistency_steps, exposed_networks, factor_words
from beers_deploy.restoration.tiles.engine import Restorer
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import RestoredRow, restore_rows, rows_to_run

RUNS_UNTIL_STEADY = 2
"""Of each tile in work at a time: then a runtime takes no more memory."""
CHECKED = (
    "the comparison of the image's own noise and edges with its sensor, and the look for faults "
    "of detectors: "
    "no part of time and throughput"
)
ALPHA = (
    "band {band} is alpha, by the file's header: it is copied, and pixels where it is 0 are "
    "missing. If it holds light, such as near infrared, write the file without alpha "
    "(gdal_translate -colorinterp_{band} undefined)"
)
MANY = 0.05
"""Share of an image above its full scale that no scene has, but a wrong full scale."""


def restore_file(
    image: Path, out: Path, options: Options, log: Log = no_log, beside: Sequence[Path | None] = ()
) -> Row:
    """Restore `image` into the TIFF `out`, and return the run's figures.

    Args:
        image: a TIFF of any size, a PNG, a JPEG, or what GDAL reads (deploy.restoration.source).
        out: a TIFF of the type `Raster.out_dtype`, in the scale of the image; larger by the
            network's factor where it has one, and in its place on Earth.
        options: what the user chose.
        log: is told the plan, the memory, and how to go on after a stop.
        beside: other files that the caller will write.
    """
    started = time.perf_counter()
    if options.scheduler is None:
        require_cores("threads", options.threads)
    with begun(image, out, options, beside) as stored, open_cluster(options.scheduler) as cluster:
        raster = stored.raster
        begun_with = stamps(stored.files)
        paths = in_order(options.bands, raster) if options.bands else [options.model]
        models = [read_network(path) for path in paths]
        networks = [network for network, _ in models]
        digests = ", ".join(digest for _, digest in models)
        require_alike(networks, paths)
        plan = plan_for(networks[0], raster.shape, options)
        log(plan.sentence)
        if raster.mask_kind == "alpha":
            log(ALPHA.format(band=raster.bands + 1))
        faults = faults_of(stored, options.fix_detectors, str(image), log)
        source = fixed(stored, faults)
        check_memory(rows_bytes(source, plan), options.memory_bytes, is_bulky(source, plan))
        scale = scale_of(source, plan, options, str(image))
        check, check_s = timed(
            partial(check_sensor, source, networks, options, scale.value, name=str(image), log=log)
        )
        exposed, at_once, runtime = _opened(networks, source, plan, options, cluster, scale.value)
        steps_taken, words = consistency_steps(options, raster, plan.tiling, scale.value)
        # Values above an assumed full scale show that the assumption is wrong, so they are refused.
        clips = not scale.assumed
        restorer = Restorer(
            raster, exposed, scale.value, plan.tiling, str(image), clips, steps_taken
        )
        figures = seam_figures(source, plan, restorer)
        job = job_of(source, digests, plan, runtime, scale.value, options, bool(steps_taken))
        job["detectors"] = faults.sha256
        needed = cog_bytes(plan.out_shape, raster.out_dtype.itemsize) if options.cog else 0
        ends = [row.keep_stop * plan.scale for row in plan.rows]
        checkpoint = Checkpoint(
            out, plan.out_shape, raster.out_dtype, job, options.resume, needed, ends
        )
        if checkpoint.damaged_rows:
            log(
                f"{checkpoint.damaged_rows} finished rows do not match their digests: they are "
                "made again"
            )
        done_rows = checkpoint.rows // plan.scale
        _finish_rows(checkpoint, source, plan, restorer, at_once, options, log)
        with _kept_for_resuming(checkpoint, log):
            require_unchanged(source, str(image), begun_with, job["image"])
        # All rows are finished: a stop now would save nothing.
        with held_back():
            about = what_was_done(networks, digests, scale)
            to_cog = (
                partial(write_cog, compression=options.compression, about=about)
                if options.cog
                else None
            )
            write_output(
                checkpoint, source, Compression.none if to_cog else options.compression, to_cog
            )
            write_list(faults, list_beside(out, options.fix_detectors))
    # The sensor check is no part of a restoration, and its time is a figure of its own.
    time_s = time.perf_counter() - started - check_s
    tally = checkpoint.tally
    if tally.clipped:
        share = tally.clipped / prod(raster.shape)
        doubt = f": {share:.0%} of the image; is that its full scale?" if share > MANY else ""
        log(f"{tally.clipped} pixels above full scale, {scale.words}, were clipped to it{doubt}")
    figures |= {"sensor check": measured(check_s, "s", CHECKED), **check.figures, **tally.figures}
    text = {**scale.text, **check.text, "consistency": words, **faults.text_of_row}
    if options.brighter:
        figures |= tally.exposure_figures
        text["exposures"] = factor_words(options.brighter)
    if steps_taken:
        figures |= tally.consistency_figures
    return run_row(image.name, plan, done_rows, time_s, runtime, options, figures, text)


def check_sensor(
    source: Source,
    networks: Sequence[onnx.ModelProto],
    options: Options,
    full_scale: float,
    name: str,
    log: Log,
) -> SensorCheck:
    """Look for faults of detectors, and compare an image with the sensor that the user named.

    Without a named sensor, log a sentence if the image looks restored already.

    Args:
        source: the image.
        networks: that are to restore it.
        options: what the user chose.
        full_scale: the pixel value that is 1.0 to the networks.
        name: of the image, for messages.
        log: is told what is seen.
    """
    if not options.again:
        warn_of_detectors(source, full_scale, log)
    if any(sensor.name != BLIND for sensor in options.sensors.values()):
        return told_sensor(source, options.sensors, full_scale, name, options.strict, log)
    sentence = "" if options.again else restored_already(source, networks, full_scale)
    if sentence:
        log(sentence)
    return SensorCheck()


def timed(work: Callable[[], SensorCheck]) -> tuple[SensorCheck, float]:
    """Return what some work returns, and the seconds that it took."""
    started = time.perf_counter()
    return work(), time.perf_counter() - started


@contextmanager
def begun(
    image: Path, out: Path, options: Options, beside: Sequence[Path | None]
) -> Iterator[Source]:
    """The open image of the only run on an output, once what is known before is found to be as it
    must.

    Args:
        image: as of `restore_file`.
        out: as of `restore_file`.
        options: what the user chose.
        beside: other files that will be written: like `out` they must be none that is read.
    """
    require_image_file(image)
    require_writable(out, inputs=[path for path in (image, options.model) if path.is_file()])
    require_tiff_name(out)
    require_codec(options.compression)
    with only_run(out), open_raster(image, options.trust_index) as source:
        # Only an open index tells which tiles are read: no output may be one of them.
        require_writable(out, *beside, inputs=source.files)
        require_raw(str(image), source.raster.restored, options.again)
        yield source


def _opened(
    networks: Sequence[onnx.ModelProto],
    source: Source,
    plan: Plan,
    options: Options,
    cluster: Cluster | None,
    full_scale: float,
) -> tuple[tuple[ExposedNetwork, ...], int, str]:
    """The networks ready to run, how many tiles are in work at a time, and the runtime's name and
    version.

    A cluster is given two tiles for each call that it runs at once, of the two rows of tiles that
    are in work.
    """
    threads = 1 if cluster else options.threads
    at_once = tiles_at_once(threads, plan.tiles)
    opened = [open_runtime(options.runtime, network, threads, at_once) for network in networks]
    infers = [infer for infer, _ in opened]
    runtime = opened[0][1]

    def at_first_call(network: onnx.ModelProto) -> Infer:
        if cluster is None:
            return Packed(network.SerializeToString(), options.runtime, threads, at_once)
        return infer_on(
            cluster, Packed(network.SerializeToString(), options.runtime, options.threads or 1)
        )

    if cluster is not None:
        infers = [at_first_call(network) for network in networks]
    about = options, source.raster, plan.tiling, full_scale
    exposed = exposed_networks(infers, *about, at_first_call)
    if cluster is not None:
        # Two rows of tiles are in work: two tiles for each of the cluster's calls keep it busy.
        at_once = max(min(2 * cluster.slots, 2 * plan.row_tiles), 1)
    return exposed, at_once, runtime


def scale_of(source: Source, plan: Plan, options: Options, name: str) -> FullScale:
    """The pixel value that is full scale; float images are read to their first bright row of tiles
    to know it.
    """
    extents = (
        source.raster.extent(source.read(row.keep_start, row.keep_stop)) for row in plan.rows
    )
    return full_scale_of(name, source.raster, extents, options.full_scale, options.sensor_bits)


def job_of(
    source: Source,
    digests: str,
    plan: Plan,
    runtime: str,
    full_scale: float,
    options: Options,
    steps: bool,
) -> dict[str, object]:
    """Return all that decides the pixels; who computes, on how many machines, is no part of it.

    Another version of this program or of the runtime might give other bits: rows of one are not
    finished by another.

    Args:
        source: the image.
        digests: of the networks at factor 1.
        plan: how the image is cut.
        runtime: its name and version.
        full_scale: the pixel value that is 1.0 to the network.
        options: what the user chose.
        steps: whether the consistency step is taken.
    """
    brighter = chain.from_iterable(files.values() for files in options.brighter.values())
    sensors = {
        band: [numbers_of(sensor), numbers_of(sensor.reference)]
        for band, sensor in options.sensors.items()
    }
    return {
        # Another version of the program or of the runtime may compute other bits.
        "program": version("beers-deploy"),
        "image": fingerprint(source.files),
        "raster": repr(source.raster),
        "model": digests,
        "exposures": [network_sha256(path) for path in brighter],
        "factors": {band: list(map(str, files)) for band, files in options.brighter.items()},
        "sensors": repr(sensors),
        "consistency": steps,
        "tile_px": plan.tile_px,
        "halo_px": plan.halo_px,
        "full_scale": full_scale,
        "runtime": runtime,
    }


def read_network(path: Path) -> tuple[onnx.ModelProto, str]:
    """Read a network and the digest of the bytes that it was read from.

    Raises:
        ModelError: a file that was replaced while it was read, besides what `load_onnx` raises.
    """
    with unchanged(path) as digest:
        network = load_onnx(path)
    return network, digest


def require_unchanged(
    source: Source, name: str, before: Sequence[tuple[int, int, int]], digest: object
) -> None:
    """Refuse an image, `name` in messages, that was replaced while its rows were read.

    Args:
        source: the image.
        name: of the image.
        before: its files' stamps before the first row was read.
        digest: its fingerprint then.
    """
    # A file that was only touched or copied back is the same image: its content decides.
    if stamps(source.files) != before and fingerprint(source.files) != digest:
        remedy = "wait until it is written, then restore it again"
        raise ImageError(
            name,
            expected="an image that stays as it is",
            got="a change while it was read",
            remedy=remedy,
        )


def _finish_rows(
    checkpoint: Checkpoint,
    source: Source,
    plan: Plan,
    restorer: Restorer,
    at_once: int,
    options: Options,
    log: Log,
) -> None:
    """Restore the rows that a checkpoint lacks, and keep each in it while the next is made."""
    rows = [row for row in plan.rows if row.keep_start * plan.scale >= checkpoint.rows]
    tiles = len(rows_to_run(plan, restorer, rows)) * plan.row_tiles
    steady = min(RUNS_UNTIL_STEADY * at_once, tiles)
    with (
        _kept_for_resuming(checkpoint, log),
        steps("restoring", tiles) as bar,
        held_back() as interrupt,
    ):

        def tick() -> None:
            bar.advance()
            # From now on the runtime takes no more memory, so what it holds can be counted.
            if bar.done == steady:
                needed = rows_bytes(source, plan, begun=True)
                most = check_memory(needed, options.memory_bytes, is_bulky(source, plan))
                log(
                    f"memory: about {most / 1e9:.2f} GB (measured after the first tiles, and "
                    "the rows to come)"
                )
            if interrupt.asked:
                raise KeyboardInterrupt

        # A generator that is closed cancels the tiles that still wait.
        with closing(restore_rows(source, plan, restorer, rows, tick, at_once)) as finished:
            _write_behind(finished, checkpoint)
        checkpoint.require_known(restorer.name)
        if not options.any_result:
            checkpoint.tally.require(restorer.name)
    for doubt in checkpoint.tally.doubts:
        log(f"look at the result: {doubt}")


@contextmanager
def _kept_for_resuming(checkpoint: Checkpoint, log: Log) -> Iterator[None]:
    """Finished rows outlive a stop and a full disk, not an image or a network that no later run
    could finish.
    """
    try:
        yield
    except KeyboardInterrupt:
        log(
            f"stopped at row {checkpoint.rows} of {checkpoint.shape[1]}; the same command with "
            "--resume goes on"
        )
        raise
    except BeersError as error:
        # An image or a network that is refused would be refused again by a later run.
        if not checkpoint.rows or not isinstance(error, MachineError):
            checkpoint.remove()
        raise


def _write_behind(restored: Iterable[RestoredRow], checkpoint: Checkpoint) -> None:
    """Keep rows, each while the next is made; never more than one waits."""
    with ThreadPoolExecutor(1) as writer:
        writing: Future[None] | None = None
        for row in restored:
            # The result raises an error of the writer, and no more than one row ever waits.
            if writing is not None:
                writing.result()
            writing = writer.submit(checkpoint.append, row)
        if writing is not None:
            writing.result()


def plan_figures(plan: Plan) -> dict[str, Figure]:
    """How an image is cut: known, but not measured."""
    numbers = {"tiles": plan.tiles, "work factor": plan.work_factor}
    source = "arithmetic on the plan of tiles"
    return {
        key: predicted(number, "1", (number, number), source) for key, number in numbers.items()
    }


def seam_figures(source: Source, plan: Plan, restorer: Restorer) -> dict[str, Figure]:
    """The error of seams, where the halo leaves any: of a tile in the middle, in digital numbers.

    The same kept pixels are restored twice: from the tile's own window, and from one with the whole
    radius around.
    """
    keys = "seam error max", "seam error mean"
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if plan.tiling.fixed_px is not None:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return dict.fromkeys(keys, unavailable("DN", reason))
    rows = plan.rows[len(plan.rows) // 2]
    columns = plan.columns[len(plan.columns) // 2]
    ends_px = plan.rows[-1].stop, plan.columns[-1].stop
    wide = [
        _widened(span, plan.radius_px, end_px)
        for span, end_px in zip((rows, columns), ends_px, strict=True)
    ]
    strip = restorer.read(source, min(rows.start, wide[0].start), max(rows.stop, wide[0].stop))
    cheap, exact = (
        restorer.tile(strip, 0, *spans).pixels.astype(np.float64)
        for spans in ((rows, columns), wide)
    )
    error = np.abs(np.nan_to_num(cheap) - np.nan_to_num(exact))
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {
        key: measured(float(value), "DN", how)
        for key, value in zip(keys, (error.max(), error.mean()), strict=True)
    }


def _widened(span: Span, radius_px: int, size_px: int) -> Span:
    """The same kept pixels with the whole radius around them, as far as the image goes, with its
    extension.

    What is kept ends on the network's lattice, or with the image: then what is read ends with the
    extension too.
    """
    start = max(span.keep_start - radius_px, 0)
    stop = min(span.keep_stop + radius_px, size_px)
    stop = size_px if span.stop == size_px else stop
    return Span(start, stop, span.keep_start, span.keep_stop)


def run_row(
    name: str,
    plan: Plan,
    done_rows: int,
    time_s: float,
    runtime: str,
    options: Options,
    more: dict[str, Figure],
    text: dict[str, str],
) -> Row:
    """The figures of one run, of which `done_rows` were finished before."""
    useful_px = plan.bands * (plan.height_px - done_rows) * plan.width_px
    source = f"from opening the image to the finished file without the sensor check, {runtime}"
    figures = {
        "time": measured(time_s, "s", source),
        "throughput": measured(
            useful_px / time_s / 1e6, "Mpx/s", f"the image's own pixels, {source}"
        ),
        **plan_figures(plan),
        "peak memory": peak_memory(),
        **more,
    }
    workers = {"workers": options.scheduler} if options.scheduler else {}
    return Row(
        "restore", name, figures, {"halo": plan.halo_words, **text, "runtime": runtime, **workers}
    )
