"""A detection study from names to rows and a page: what `beers-deploy detect` does between options and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.bench.pair import TABLE as PAIR
from deploy.bench.pair import pair_on_board
from deploy.cache import Cache
from deploy.detection.classes import class_map
from deploy.detection.detectors import Detector, open_detector
from deploy.detection.matching import require_library
from deploy.detection.page import crops, curves
from deploy.detection.retrain import TABLE, Retraining, conditions
from deploy.detection.rows import (
    PAPER_NOTES,
    PAPER_TABLE,
    detection_rows,
    few_sites,
    headline,
    main_table,
    paper_rows,
)
from deploy.detection.study import Comparison, Sensors, Study, network_digest, rows_of
from deploy.detection.subjects import Subject, drawn_subjects, left_out, read_subjects
from deploy.dpu.board import load_dpu
from deploy.methods import AT
from deploy.networks import Say, network_file, once
from deploy.report.page import Report, Table, write_report
from model.detection.scenes import CLASSES
from model.metrics.bootstrap import LEAST_SITES
from model.shipped import DETECTOR, DETECTOR_INT8
from profiles.errors import ModelError
from profiles.figures import Row, by_table
from profiles.sensor import SensorProfile
from profiles.sensor_file import load_sensor, reference_beside
from profiles.target import DEFAULT_TARGET

REPORT = "report.html"


@dataclass(frozen=True)
class DetectionRequest:
    """What is looked at, by what, and how.

    Attributes:
        images: folder of labelled pictures; None for drawn scenes.
        labels: where their labels lie, if not beside them.
        split: name of a list of pictures in the folder; None for all.
        detector: ONNX file; None for the embedded one.
        sensors: profiles of degraded images, by name or file.
        reference: profile of the reference images; None for the default one.
        methods: names of the rows besides the reference, the degraded images among them.
        size_px: side of the detector's input, where its file leaves it open.
        classes: names of labelled classes to the detector's, where letters do not match.
        drawn: how many scenes to draw.
        retrain: whether the embedded detector is also trained for each row anew, on drawn scenes.
        seed: of every random draw.
    """

    images: Path | None
    labels: Path | None
    split: str | None
    detector: Path | None
    sensors: Sequence[str]
    reference: str | None
    methods: Sequence[str]
    size_px: int | None
    classes: Mapping[str, str]
    drawn: int
    retrain: bool
    seed: int

    @property
    def detector_file(self) -> Path:
        """The detector that is meant."""
        return self.detector or DETECTOR


@dataclass(frozen=True)
class DetectionRun:
    """What a detection study found.

    Attributes:
        compared: by sensor.
        more: rows of the pair on a board, and of detectors trained for each row where that was asked for.
        notes: what a reader of the tables must know.
    """

    compared: Sequence[Comparison]
    more: Sequence[Row]
    notes: Sequence[str]

    @property
    def pictures(self) -> list[Path]:
        """The files of the scenes that were looked at; none of drawn ones."""
        return [view.subject.path for view in self.compared[0].views if view.subject.path is not None]

    @property
    def rows(self) -> tuple[Row, ...]:
        """Every table, and the paper's."""
        return (*(row for found in self.compared for row in detection_rows(found)), *self.more, *paper_rows())

    @property
    def shown(self) -> list[Row]:
        """The rows that a terminal shows; the page and the document hold all."""
        shown = {*map(main_table, (found.name for found in self.compared)), PAIR, TABLE, PAPER_TABLE}
        return [row for row in self.rows if row.table in shown]

    @property
    def headline(self) -> str:
        """What was lost and what came back, by sensor."""
        return headline(self.compared)

    @property
    def title(self) -> str:
        """How much was looked at."""
        subjects = [view.subject for view in self.compared[0].views]
        objects = sum(int((~subject.truth.ignored).sum()) for subject in subjects)
        return f"What restoration buys a detector: {objects} objects on {len(subjects)} images"

    def write(self, out: Path) -> Path:
        """Write the page into a folder; returns its path."""
        tables = [
            Table(name, rows, CAPTIONS.get(name.split(",")[0], "")) for name, rows in by_table(self.rows).items()
        ]
        pictures = [curves(self.compared), *crops(self.compared)]
        write_report(
            Report(self.title, self.headline, tables, pictures, (*self.notes, *NOTES, *PAPER_NOTES)), out / REPORT
        )
        return out / REPORT


CAPTIONS = {
    "detection": "Precision and recall at the confidence of the reference's best F1, the one a deployed detector is "
    "set to. Gains and losses are of mAP50, on the same images; where their interval holds 0, there is none.",
    TABLE: "The embedded detector trained from drawn weights on each row's own pictures and tested on such: the "
    "paper's protocol. Means over seeds; the brackets hold the least and the largest. Precision and recall at each "
    "detector's own best F1.",
    PAIR: "Of a frame of the detector's input, restored and then looked at on one DPU: predicted, nothing has run.",
    "mAP50 by size": "Root of a box's area, in pixels of the scene.",
}
NOTES = (
    "mAP50: average precision at an overlap of half, mean over classes; mAP50-95: mean over 0.5 to 0.95 (COCO).",
    "Share of loss regained: gain over what degradation took; unavailable where that loss cannot be told from 0.",
    "The detector is fixed, and was trained for none of the degraded or restored images.",
    "It is shown one panchromatic band in all three, under one stretch for all rows of a scene.",
)


def run_detection(request: DetectionRequest, cache: Cache, say: Say) -> DetectionRun:
    """Show one detector the same scenes as the reference sees them, degraded and restored, under each sensor.

    Args:
        request: what is looked at, by what.
        cache: of what was found: a run that was stopped goes on where it was.
        say: is told what a user should know on the way.

    Raises:
        BeersError: a name, a file or a folder that is not what it should be.
    """
    require_library()
    detector = open_detector(request.detector_file, size_px=request.size_px)
    subjects, notes = _subjects(request, detector)
    told = once(say)
    sensors = [_sensors(name, request.reference, told) for name in request.sensors]
    rows = [rows_of(each, request.methods, told) for each in sensors]
    study = Study(detector, request.detector_file, subjects, request.seed, cache)
    compared = [study.compare(*each) for each in zip(sensors, rows, strict=True)]
    more, remarks = _pair(request, sensors[0].degraded)
    if request.retrain:
        trained = conditions(sensors, request.methods[-1], told)
        more += Retraining(trained, subjects, request.seed, cache).run()
    sites, warning = compared[0].differences.sites, compared[0].differences.warning
    said = (detector.flag, few_sites(sites) if sites < LEAST_SITES else warning, *notes, *remarks)
    return DetectionRun(compared, more, [note for note in said if note])


def _sensors(name: str, reference: str | None, say: Say) -> Sensors:
    degraded = load_sensor(name)
    return Sensors(degraded, reference_beside(degraded, reference, say))


def _subjects(request: DetectionRequest, detector: Detector) -> tuple[list[Subject], list[str]]:
    """The scenes, and what a reader must know of them."""
    if request.images is not None:
        return read_subjects(detector.names, request.classes, request.images, request.labels, request.split)
    known = class_map(CLASSES, detector.names, request.classes)
    subjects = drawn_subjects(request.drawn, request.seed, known)
    said = f"The {len(subjects)} scenes are drawn, each a site of its own: no photographs."
    return subjects, [said, *left_out(known)]


def _pair(request: DetectionRequest, sensor: SensorProfile) -> tuple[list[Row], list[str]]:
    """What the last network among the methods and the detector take together on the default board, or why not."""
    networks = [name.partition(AT)[0] for name in request.methods if network_digest(name, sensor)]
    if not networks:
        return [], []
    try:
        restorer = network_file(Path(networks[-1]), sensor)
        return list(pair_on_board(restorer, request.detector or DETECTOR_INT8, load_dpu(DEFAULT_TARGET))), []
    except ModelError as error:
        return [], [f"No time of restoration and detection on a board: {error}"]
