"""`demo`: the whole chain on one image, with a report at the end."""

import logging
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from beers_deploy.model.shipped import INT8, SENSOR, VARIANT
from beers_deploy.profiles.errors import optional
from beers_deploy.verbs.check import check
from beers_deploy.verbs.gate import gate
from beers_deploy.verbs.parameters import Holds, InputPath, OutputFolder, Progress, Seed, SensorLike
from beers_deploy.verbs.restore import restore
from beers_deploy.verbs.verb import path_or_none, refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.results import Table

logger = logging.getLogger(__name__)

FILES = ("report.html", "float.onnx", "int8.onnx", "core.onnx", "restored.tif", "before-after.png")
"""The files of a run. core.onnx is the network in the board's encoding."""

GATE_PATCHES = 12
STEPS = 6


@verb
def demo(
    *,
    image: InputPath | None = None,
    full_scale: float | None = None,
    sensor: SensorLike = SENSOR,
    out: Annotated[OutputFolder, Holds(*FILES)] = "demo",
    seed: Seed = 0,
    progress: Progress = None,
) -> "Table":
    """Simulate, gate, check, restore and predict one scene, and write a report.

    Args:
        image: raw 12-bit image, or an 8-bit photograph as the scene; a drawn scene by default.
        full_scale: full scale of a raw image; 4095 by default. Needed for 0..1.
        sensor: 12-bit sensor of the raw image or of the simulation: name or .toml file.
        out: folder for report.html and files.
        seed: seed of every random draw.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of time, power, quality and what INT8 changes.

    Raises:
        ImageError: an image that cannot be read.
        OptionError: a sensor of other than 12 bits.
        MissingExtraError: torch, scikit-image or matplotlib is not installed.
    """
    refuse_without("`image`", full_scale=full_scale is not None and image is None)
    # Packages of the last steps are checked before the first step writes.
    for package in ("skimage", "matplotlib"):
        optional(package, "demo")
    # These load torch.
    import numpy as np

    from beers_deploy.model.progress import steps
    from beers_deploy.model.raster.writer import write_tiff
    from beers_deploy.network import Network
    from beers_deploy.profiles.instrument import MAX_DN
    from beers_deploy.report.page import Report, Section, write_report
    from beers_deploy.results import Table
    from beers_deploy.studies import demo as parts

    folder = Path(out)
    path = path_or_none(image)
    with steps("demo", STEPS) as bar:
        bar.advance(0, "reading the image")
        sensors = parts.load_sensors(sensor)
        degraded, pair = parts.read_input(path, seed, sensors, full_scale)
        bar.advance(1, "conditioning the networks on the sensor")
        floating = Network.load(VARIANT, sensor=sensors[0])
        int8 = Network.load(f"{VARIANT}{INT8}", sensor=sensors[0])
        for name, network in (("float", floating), ("int8", int8), ("core", int8.core())):
            network.save(folder / f"{name}.onnx")
        bar.advance(1, "comparing INT8 with float")
        verdict = gate(floating, int8, sensor=sensors[0], patches=GATE_PATCHES, seed=seed)
        bar.advance(1, "checking every operator against the DPU")
        placement = check(int8, tile=640).placement
        bar.advance(1, "restoring with the traditional pipeline and with INT8")
        traditional = restore(degraded, method="traditional", sensor=sensors[0], full_scale=MAX_DN)
        # The file stores integers, so these are measured and shown.
        floats = restore(degraded, network=int8, sensor=sensors[0], full_scale=MAX_DN)
        restored = np.rint(floats)
        write_tiff(folder / "restored.tif", restored.astype(np.uint16))
        images = {parts.INPUT: degraded, parts.TRADITIONAL: traditional, parts.INT8: restored}
        quality = [] if pair is None else parts.quality_rows(images, pair, degraded)
        if pair is not None:
            images[parts.REFERENCE] = pair.reference
        bar.advance(1, "measuring the traditional pipeline, predicting the board")
        bench = parts.bench_tables(int8, degraded, sensors)
        bar.advance(1, "done")
    sections = [*bench]
    if quality:
        sections.append(Section("Quality on this image, over 4095 DN", quality))
    sections.append(Section("What quantisation changes", verdict.rows, parts.GATE_CAPTION))
    headline = parts.headline(bench[0].rows, quality, placement)
    title = "From training to board, on one image"
    pictures = parts.pictures_of(images, folder)
    page = folder / "report.html"
    write_report(Report(title, headline, sections, pictures, parts.NOTES), page)
    logger.info("report: %s", page)
    rows = list(chain.from_iterable(section.rows for section in sections))
    return Table(
        title=title,
        inputs=() if path is None else (path,),
        rows=tuple(rows),
        notes=(headline,),
        headings={section.rows[0].table: section.title for section in sections},
        details=parts.DETAILS,
    )
