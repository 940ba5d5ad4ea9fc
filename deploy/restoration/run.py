"""Restore an image file into another one, as `restore` does with files.

open -> faulty detectors -> prepare -> rows that a checkpoint lacks -> the TIFF -> figures

One row is written while the next is computed. Whatever stops a run, the output is the old one or
the new one. Finished rows stay in the checkpoint if a later run can continue from them.
"""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from math import prod
from pathlib import Path

from beers_deploy.model.interval import HalfWidth
from beers_deploy.model.io.files import require_writable, write_text
from beers_deploy.model.io.lock import only_run
from beers_deploy.model.progress import held_back, steps
from beers_deploy.model.raster.facts import require_raw
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.model.raster.source import Source, fingerprint, stamps
from beers_deploy.model.raster.writer import cog_bytes, padded_px, require_codec
from beers_deploy.network import Network
from beers_deploy.profiles.errors import BeersError, ImageError, MachineError, OptionError
from beers_deploy.profiles.figures import Figure, Row, measured
from beers_deploy.profiles.sensor import numbers_of
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.checkpoint import Checkpoint
from beers_deploy.restoration.cluster import open_cluster
from beers_deploy.restoration.detectors.fault_list import FOUND, FaultList, found_list_path
from beers_deploy.restoration.detectors.fix import FixedSource, faults_of
from beers_deploy.restoration.interval import (
    HalfWidths,
    half_widths_of,
    write_half_widths,
)
from beers_deploy.restoration.memory import FLOAT_BYTES, peak_memory
from beers_deploy.restoration.output import Output, what_was_done, write_output
from beers_deploy.restoration.prepare import Pipeline, Restoration
from beers_deploy.restoration.radiometry import Reading
from beers_deploy.restoration.self_check import check_result, checks_of, write_map
from beers_deploy.results import Input, Table

logger = logging.getLogger(__name__)

CHECKED = (
    "the comparison of the image's own noise and edges with its sensor, and the search for faults "
    "of detectors: no part of time and throughput"
)
SELF_CHECKED = "the self-check of all blocks: no part of time and throughput"
ALPHA = (
    "band {band} is alpha, by the file's header: it is copied, and pixels where it is 0 are "
    "missing. If it holds light, such as near infrared, write the file without alpha "
    "(gdal_translate -colorinterp_{band} undefined)"
)
MANY = 0.05
"""Share of an image above its full scale that no scene has, but a wrong full scale."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Run(Table):
    """The table of results of one file that was restored into another, which `restore` returns.

    Attributes:
        path: the path of the restored image.
        time_s: the seconds from opening the image to the finished file, without those of the sensor
            check and the self-check.
        networks: the networks that restored the bands, in the order of the bands; empty for the
            traditional pipeline.
    """

    path: Path
    time_s: float
    networks: Sequence[Network] = ()


def restore_file(
    image: Path, output: Output, reading: Reading, load: Callable[[], Pipeline]
) -> Run:
    """Restore an image file into a TIFF, and return the table of the run's figures.

    The TIFF has the pixel type `Raster.out_dtype`, the full scale and the place on Earth of the
    image. It is larger than the image if the network enlarges images.

    Args:
        image: a file that `model.raster.reader.open_raster` opens, of any size.
        output: the files to write, and whether an earlier run is continued.
        reading: how the pixels of the image are interpreted.
        load: returns the pipeline that restores the image, a network or the traditional one. It is
            called once the image and the output are accepted.

    Raises:
        OptionError: an option does not fit the image, the network or an earlier run.
        ImageError: the image cannot be read, changed during the run, or has an implausible result.
        ModelError: the network cannot restore the image.
        MachineError: the memory or the disk is too small, or the workers do not answer.
    """
    out = output.path
    widths = output.interval_path
    with ExitStack() as stack:
        stored = stack.enter_context(begun(image, output, reading))
        pipeline = load()
        started = time.perf_counter()
        cluster = stack.enter_context(open_cluster(pipeline.engine.scheduler))
        before = stamps(stored.files)
        if stored.raster.mask_kind == "alpha":
            logger.info(ALPHA.format(band=stored.raster.bands + 1))
        faults = faults_of(stored, reading.fix_detectors, str(image))
        read_from = FixedSource(stored, faults) if faults.faults else stored
        work = pipeline.prepare(read_from, reading, str(image), cluster)
        checks = checks_of(reading.sensors, stored.raster, work.out_shape, work.scale.value)
        if output.self_check is not None and not checks:
            raise OptionError(
                "`self_check` needs a known sensor, and a network that returns one pixel of the "
                "same band for each pixel. Name the sensor with `sensor`, or omit `self_check`."
            )
        bands = () if output.interval is None else half_widths_of(work, output.interval)
        checkpoint = _checkpoint(output, work, faults)
        done_px = checkpoint.rows
        with _rows_for_resuming(checkpoint, bool(work.row_ends)):
            _finish_rows(checkpoint, work)
            self_check_started = time.perf_counter()
            blocks = check_result(work.source, checkpoint.read, checks)
            self_check_s = time.perf_counter() - self_check_started
            require_unchanged(stored, str(image), before, checkpoint.job["image"])
            if reading.strict:
                blocks.require(str(image))
        # All rows are finished: a stop now would save nothing.
        with held_back():
            interval = _write_interval(widths, output, work, checkpoint, bands)
            listed = found_list_path(out, reading.fix_detectors)
            if listed is not None:
                write_text(listed, faults.text)
            if output.self_check is not None:
                write_map(output.self_check, blocks, stored.raster)
            # Last, because the finished rows are removed then: what fails before can be resumed.
            about = what_was_done(work.networks, work.scale)
            write_output(checkpoint, work.source, output, about)
    # The two checks are no part of a restoration, and their times are figures of their own.
    time_s = time.perf_counter() - started - work.check_s - self_check_s
    _warn_of_clipping(work, checkpoint)
    if blocks.doubt:
        logger.warning(f"the result {blocks.doubt}")
    self_check = {**blocks.figures, "self-check": measured(self_check_s, "s", SELF_CHECKED)}
    more = {**(self_check if blocks.bands else {}), **interval}
    row = _row(image.name, work, checkpoint, done_px, time_s, faults, more)
    inputs: list[Input | Path] = [*_inputs(work), image]
    if reading.fix_detectors not in ("", FOUND):
        inputs.append(Path(reading.fix_detectors))
    # Files that the user names are not listed; those next to the output have names of ours.
    written = " and ".join(str(path) for path in (out, widths, listed) if path is not None)
    return Run(
        title=f"wrote {written}",
        inputs=tuple(inputs),
        rows=(row,),
        headings={"restore": ""},
        details=DETAILS,
        path=out,
        time_s=time_s,
        networks=tuple(work.networks),
    )


DETAILS = frozenset({"runtime", "sensor check", "self-check", "interval", "work factor"})
"""Figures and words for a closer look."""


def _write_interval(
    path: Path | None,
    output: Output,
    work: Restoration,
    checkpoint: Checkpoint,
    bands: tuple[HalfWidth, ...],
) -> dict[str, Figure]:
    """Write the half-widths to a file if they are requested, and return the figure of the time."""
    if path is None or output.interval is None:
        return {}
    started = time.perf_counter()
    widths = HalfWidths(work.source, checkpoint.read, bands)
    with checkpoint.disk():
        write_half_widths(path, widths, output.interval, output.compression)
    source = f"half-widths of the {output.interval} % interval: computed, written and compared"
    return {"interval": measured(time.perf_counter() - started, "s", source)}


def _inputs(work: Restoration) -> list[Input]:
    """Return the networks as inputs of the table of results; each of several names its band."""
    if len(work.networks) < 2:
        return [network.input for network in work.networks]
    # The user may name the bands in another order than that of the image and of the networks.
    bands = in_order({band: band for band in work.reading.sensors}, work.source.raster)
    return [
        network.input._replace(name=f"{network.input.name}, {band}")
        for band, network in zip(bands, work.networks, strict=True)
    ]


@contextmanager
def begun(image: Path, output: Output, reading: Reading) -> Iterator[Source]:
    """Open the image of a run, after all checks that need no pixels, and lock its output.

    While the image is open, no other run may write the same output.

    Args:
        image: the file to restore.
        output: the files to write.
        reading: the options of the run, of which `force` accepts an image that was restored before.

    Yields:
        The opened image.

    Raises:
        BeersError: the image cannot be opened or was restored before, the output cannot be
            written, is an input or has a codec that GDAL lacks, or another run writes it.
    """
    require_codec(output.compression)
    with only_run(output.path), open_raster(image, reading.force) as source:
        # Only an open index tells which tiles are read: no output may be one of them.
        require_writable(output.path, *output.others, inputs=source.files)
        require_raw(str(image), source.raster.restored, reading.force)
        yield source


def _checkpoint(output: Output, work: Restoration, faults: FaultList) -> Checkpoint:
    """Open the checkpoint of a run, with the rows that an earlier run of the same job finished."""
    raster = work.source.raster
    sensors = {
        band: [numbers_of(sensor), numbers_of(sensor.reference)]
        for band, sensor in work.reading.sensors.items()
    }
    job = {
        # Another version of the program or of the runtime may compute other bits.
        "program": version("beers-deploy"),
        "image": fingerprint(work.source.files),
        "raster": repr(raster),
        "sensors": repr(sensors),
        "full_scale": work.scale.value,
        "detectors": faults.sha256,
        **work.identity,
    }
    needed = cog_bytes(work.out_shape, raster.out_dtype.itemsize) if output.cog else 0
    if output.interval is not None:
        # Half-widths are written as float32, before the rows are removed.
        needed += padded_px(raster.shape) * FLOAT_BYTES
    checkpoint = Checkpoint(
        output.path, work.out_shape, raster.out_dtype, job, output.resume, needed, work.row_ends
    )
    if checkpoint.damaged_rows:
        logger.warning(
            "%d finished rows do not match their digests: they are restored again",
            checkpoint.damaged_rows,
        )
    return checkpoint


def require_unchanged(
    source: Source, name: str, before: Sequence[tuple[int, int, int]], digest: object
) -> None:
    """Raise ImageError if an image was replaced while its rows were read.

    Args:
        source: the image.
        name: the name of the image, for the message.
        before: size, time of change and inode of each file of the image before the first row was
            read, as `stamps` returns them.
        digest: the `fingerprint` of the files' content at that time.
    """
    # A file that was only touched or copied back is the same image: its content decides.
    if stamps(source.files) != before and fingerprint(source.files) != digest:
        raise ImageError(
            f"{name} changed while it was read. Wait until it is written, then restore it again."
        )


def _finish_rows(checkpoint: Checkpoint, work: Restoration) -> None:
    """Restore the rows that a checkpoint lacks, and store each while the next is computed."""
    total = work.ticks(checkpoint.rows)
    with steps("restoring", total) as bar, held_back() as interrupt:

        def tick(count: int) -> None:
            bar.advance(count)
            work.watch_memory(bar.done, total)
            if interrupt.asked:
                raise KeyboardInterrupt

        # A generator that is closed cancels the tiles that still wait.
        with (
            closing(work.rows(checkpoint.rows, tick)) as finished,
            ThreadPoolExecutor(1) as writer,
        ):
            writing = writer.submit(lambda: None)
            for row in finished:
                # The result raises an error of the writer, and no more than one row ever waits.
                writing.result()
                writing = writer.submit(checkpoint.append, row)
            writing.result()
        if not checkpoint.tally.valid_results:
            raise ImageError(
                f"{work.name} has no pixels with values, only NaN or nodata. Check that it is the "
                "right file."
            )
        if not work.reading.force:
            checkpoint.tally.require(work.name)
    for doubt in checkpoint.tally.doubts:
        logger.warning("look at the result: %s", doubt)


@contextmanager
def _rows_for_resuming(checkpoint: Checkpoint, resumable: bool) -> Iterator[None]:
    """Delete the finished rows after an error, unless a later run can continue from them."""
    try:
        yield
    except KeyboardInterrupt:
        if resumable:
            logger.warning(
                "stopped at row %d of %d; run it again with `resume` to go on",
                checkpoint.rows,
                checkpoint.shape[1],
            )
        else:
            checkpoint.remove()
        raise
    except Exception as error:
        full_disk = isinstance(error, MachineError) and checkpoint.rows > 0
        # An image or a network that is refused would be refused again by a later run.
        is_refused = isinstance(error, BeersError) and not full_disk
        if is_refused or not resumable:
            checkpoint.remove()
        raise


def _warn_of_clipping(work: Restoration, checkpoint: Checkpoint) -> None:
    clipped = checkpoint.tally.clipped
    if clipped:
        share = clipped / prod(work.source.raster.shape)
        doubt = f": {share:.0%} of the image; is that its full scale?" if share > MANY else ""
        logger.warning(
            "%d pixels above full scale, %s, were clipped to it%s", clipped, work.scale.words, doubt
        )


def _row(
    name: str,
    work: Restoration,
    checkpoint: Checkpoint,
    done_px: int,
    time_s: float,
    faults: FaultList,
    more: dict[str, Figure],
) -> Row:
    """Return the row of results of one run, with the figures `more`. The throughput counts only the
    rows after the first `done_px`, which an earlier run finished.
    """
    raster = work.source.raster
    left = 1 - done_px / checkpoint.shape[1]
    useful_px = prod(raster.shape) * left
    source = f"from opening the image to the finished file without the sensor check, {work.how}"
    figures = {
        "time": measured(time_s, "s", source),
        "throughput": measured(
            useful_px / time_s / 1e6, "Mpx/s", f"the image's own pixels, {source}"
        ),
        "peak memory": peak_memory(),
        "sensor check": measured(work.check_s, "s", CHECKED),
        **work.check.figures,
        **work.figures(checkpoint.tally),
        **more,
    }
    replaced = {"detectors replaced": faults.words} if faults.faults else {}
    text = {**work.scale.text, **work.check.text, **replaced, **work.text}
    return Row("restore", name, figures, text)
