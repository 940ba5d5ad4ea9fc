"""The traditional pipeline on an image file of any size: what `restore --method traditional` does.

Rows come and go in strips, so that memory grows with the width alone. The pipeline depends on the
sensor alone: its MTF, noise and gain. The reference it imitates is seen with the sensor's own gain
and bits, so that the output has the scale of the input.
"""

import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beers_deploy.host_state import peak_memory
from beers_deploy.model.progress import Log, Steps, no_log, steps
from beers_deploy.model.raster.source import Source, fingerprint, stamps, strips
from beers_deploy.model.traditional.pipeline import Chain, restore_strips
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.figures import Row, measured
from beers_deploy.restoration.checkpoint import Checkpoint
from beers_deploy.restoration.detectors.fault_list import list_beside, write_list
from beers_deploy.restoration.detectors.fix import faults_of, fixed
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.output import write_output
from beers_deploy.restoration.plan import Span, check_memory
from beers_deploy.restoration.radiometry import full_scale_of
from beers_deploy.restoration.run import CHECKED, begun, check_sensor, require_unchanged, timed
from beers_deploy.restoration.tiles.engine import as_stored, checked_strip
from beers_deploy.restoration.tiles.rows import RestoredRow

STRIP_PX = 128
"""Rows read at a time."""

FIXED_BYTES = 100_000_000
BYTES_PER_COLUMN = 40_000
"""Of memory that the pipeline takes, and more for each pixel of a row: some 700 rows, in several
float32 copies. Measured at 400 and 1200 columns: 75 MB and 30 kB.
"""


def restore_file_traditionally(
    image: Path, out: Path, options: Options, log: Log = no_log, beside: Sequence[Path | None] = ()
) -> Row:
    """As `deploy.restoration.run.restore_file`, of a mono image, by the traditional pipeline of its
    one sensor.
    """
    started = time.perf_counter()
    sensor = options.sensors[""]
    chain = Chain(sensor.nominal(), sensor.reference.nominal())
    with begun(image, out, options, beside) as stored:
        raster = stored.raster
        if raster.bands > 1:
            remedy = "extract the band that the profile describes"
            raise ImageError(
                str(image), expected="one band", got=f"{raster.bands} bands", remedy=remedy
            )
        faults = faults_of(stored, options.fix_detectors, str(image), log)
        source = fixed(stored, faults)
        needed = FIXED_BYTES + BYTES_PER_COLUMN * raster.width_px + source.held_bytes(STRIP_PX)
        check_memory(needed, options.memory_bytes, bulky=False)
        extents = (raster.extent(source.read(*rows)) for rows in strips(raster.height_px, STRIP_PX))
        scale = full_scale_of(str(image), raster, extents, options.full_scale, options.sensor_bits)
        check, check_s = timed(
            partial(check_sensor, source, (), options, scale.value, name=str(image), log=log)
        )
        begun_with = stamps(source.files)
        digest = fingerprint(source.files)
        job = {"image": digest, "method": "traditional"}
        checkpoint = Checkpoint(out, raster.shape, raster.out_dtype, job, resume=False)
        try:
            fitted = _fitted(source, chain, scale.value, str(image))
            _fill(checkpoint, source, fitted, scale.value, str(image))
            require_unchanged(source, str(image), begun_with, digest)
            write_output(checkpoint, source, options.compression)
            write_list(faults, list_beside(out, options.fix_detectors))
        # No run can go on from a strip, because the pipeline looks hundreds of rows back.
        except BaseException:
            checkpoint.remove()
            raise
    time_s = time.perf_counter() - started - check_s
    how = (
        "from opening the image to the finished file without the sensor check, "
        f"{torch.get_num_threads()} threads"
    )
    figures = {
        "time": measured(time_s, "s", how),
        "throughput": measured(raster.height_px * raster.width_px / time_s / 1e6, "Mpx/s", how),
        "peak memory": peak_memory(),
        "sensor check": measured(check_s, "s", CHECKED),
        **check.figures,
    }
    text = {
        "method": "traditional",
        "sensor": sensor.name,
        **scale.text,
        **check.text,
        **faults.text_of_row,
    }
    return Row("restore", image.name, figures, text)


def _fitted(source: Source, chain: Chain, full_scale: float, name: str) -> Chain:
    """Derive the regularisation of the pipeline from a first pass over the image, which takes
    little of the time.
    """
    to_dn = chain.degraded.max_dn / full_scale
    # The regularisation is the Wiener optimum of the whole image: it needs all strips.
    with steps("measuring noise and contrast", source.raster.height_px) as bar:
        return chain.fitted_to(_counted(_read(source, to_dn, full_scale, name), bar))


def _counted(strips_read: Iterator[Tensor], bar: Steps) -> Iterator[Tensor]:
    """Pass strips on as they come, and report the rows of each once the next one is asked for."""
    for strip in strips_read:
        yield strip
        bar.advance(strip.shape[0])


def _fill(
    checkpoint: Checkpoint, source: Source, chain: Chain, full_scale: float, name: str
) -> None:
    raster = source.raster
    to_dn = chain.degraded.max_dn / full_scale
    top = 0
    with steps("restoring rows", raster.height_px) as bar:
        raw_strips = _read(source, to_dn, full_scale, name)
        for strip in restore_strips(raw_strips, raster.height_px, chain):
            stop = top + strip.shape[0]
            missing = torch.isnan(strip).numpy()[None]
            pixels = as_stored(
                raster, np.nan_to_num(strip.numpy()[None] / np.float32(to_dn)), full_scale
            )
            if missing.any():
                stored = np.ma.getdata(source.read(top, stop))
                pixels = np.where(missing, stored.astype(raster.out_dtype), pixels)
            tally = Tally(int((~missing).sum()))
            checkpoint.append(RestoredRow(Span(top, stop, top, stop), pixels, tally))
            bar.advance(stop - top)
            top = stop
    checkpoint.require_known(name)


def _read(source: Source, to_dn: float, full_scale: float, name: str) -> Iterator[Tensor]:
    """Strips (rows, width) float32 of digital numbers, NaN where they are missing."""
    for start, stop in strips(source.raster.height_px, STRIP_PX):
        strip = checked_strip(source.raster, start, source.read(start, stop), full_scale, name)
        dn = strip.pixels[0].astype(np.float32) * np.float32(to_dn)
        if strip.missing is not None:
            dn[strip.missing[0]] = np.nan
        yield torch.from_numpy(dn)
