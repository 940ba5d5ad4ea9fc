"""What a detection study found, as one table and a page."""

import logging
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from beers_deploy.results import Table
from beers_deploy.studies.detection.average_precision import sites_note
from beers_deploy.studies.detection.detector import Detector
from beers_deploy.studies.detection.page import write_page
from beers_deploy.studies.detection.study import Comparison, LabelledScene
from beers_deploy.studies.detection.tables import (
    MAIN,
    PAPER_TABLE,
    detection_rows,
    headline,
    paper_rows,
)

logger = logging.getLogger(__name__)

PAGE = "report.html"


def detection_table(
    compared: Sequence[Comparison],
    file: Path,
    detector: Detector,
    scenes: Sequence[LabelledScene],
    notes: Sequence[str],
    out: Path | None,
) -> Table:
    """Return the figures of a study, and write its page.

    Args:
        compared: under each sensor.
        file: of the detector.
        detector: that was shown the scenes.
        scenes: labelled.
        notes: what a reader must know of the labels.
        out: folder of the page; None writes none.
    """
    rows = [*chain.from_iterable(map(detection_rows, compared)), *paper_rows()]
    known = (detector.flag, sites_note(compared[0].sites), *notes)
    sentences = [note for note in known if note]
    if out is not None:
        write_page(compared, rows, sentences, out / PAGE)
        logger.info("wrote %s", out / PAGE)
    tables = {row.table for row in rows}
    return Table(
        inputs=(file, *(scene.path for scene in scenes if scene.path is not None)),
        rows=tuple(rows),
        notes=(*sentences, headline(compared)),
        details=frozenset(name for name in tables if not name.startswith((MAIN, PAPER_TABLE))),
    )
