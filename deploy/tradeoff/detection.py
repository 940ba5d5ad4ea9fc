"""What a detector finds on labelled images that each variant restored: a quality beside those of the pictures.

As `detect` does it: scene -> acquisition by the study's sensor -> restoration -> display -> detector -> mAP50. What
was found on a picture is kept as soon as it is there.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from deploy.cache import Cache, Key, code_digest, digest_of
from deploy.detection.boxes import Boxes
from deploy.detection.detectors import open_detector
from deploy.detection.differences import estimate, site_draws, warning_of
from deploy.detection.matching import Matched, require_library
from deploy.detection.rows import share_figure
from deploy.detection.scores import ap50
from deploy.detection.study import REFERENCE, Sensors, Study
from deploy.detection.subjects import read_subjects
from model.evaluation.methods import DEGRADED, Method, Restore
from model.io.images import image_size_px
from model.shipped import DETECTOR
from profiles.figures import Figure
from profiles.sensor import SensorProfile

OTHER_HALO = "measured with the exact halo alone: how often a seam cuts an object is not known"

Contents = Mapping[str, str]
"""What the pictures of each row depend on, by the name of the row."""

BESIDE: Contents = {REFERENCE: "", DEGRADED: ""}
"""Rows that are no variants: between them lies what there is to regain."""


@dataclass(frozen=True)
class Request:
    """Which labelled images are looked at, and by what.

    Attributes:
        images: folder of labelled pictures.
        detector: ONNX file; the embedded one if None.
        classes: names of labelled classes to the detector's, where letters do not match.
    """

    images: Path
    detector: Path | None
    classes: Mapping[str, str]

    @property
    def file(self) -> Path:
        """The detector that is meant."""
        return self.detector or DETECTOR


@dataclass(frozen=True)
class Detected:
    """Average precision at an overlap of one half, mean over classes.

    Attributes:
        ap50: on all images, 0 to 1; NaN where there is no object.
        draws: on each bootstrap draw of the sites, the same ones for all rows; NaN where a draw holds no object.
        images: how many.
        sites: how many different ones.
    """

    ap50: float
    draws: tuple[float, ...]
    images: int
    sites: int

    @classmethod
    def of(cls, matched: Matched, seed: int) -> Self:
        """The score of a row; the same seed draws the same sites."""
        draws = [ap50(matched, weights) for weights in site_draws(matched.sites, np.random.default_rng(seed))]
        count = len(matched.sites)
        return cls(ap50(matched, np.ones(count, np.int64)), tuple(draws), count, len(set(matched.sites)))

    def to_json(self) -> dict[str, object]:
        """What JSON can hold, for the cache."""
        return vars(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """A score as `to_json` wrote it; raises KeyError, TypeError or ValueError on anything else."""
        return cls(float(stored["ap50"]), tuple(map(float, stored["draws"])), stored["images"], stored["sites"])

    @property
    def figure(self) -> Figure:
        """In %, with its interval where there are sites enough."""
        return share_figure(estimate(self.ap50, np.array(self.draws), self.sites), self.images, self.sites)

    def gain(self, other: "Detected") -> tuple[float, float]:
        """Interval of this less the other in points, paired by draw; endless where the sites are too few."""
        ends = estimate(self.ap50 - other.ap50, np.array(self.draws) - np.array(other.draws), self.sites).interval
        return (100 * ends[0], 100 * ends[1]) if ends else (-np.inf, np.inf)


@dataclass(frozen=True)
class Detection:
    """Where variants are looked at.

    Attributes:
        study: the detector, the labelled scenes, and where results are kept.
        sensors: that acquire the scenes.
        remarks: what a reader must know of the labels and the detector.
    """

    study: Study
    sensors: Sensors
    remarks: tuple[str, ...]

    @classmethod
    def open(cls, request: Request, profiles: tuple[SensorProfile, SensorProfile], seed: int, cache: Cache) -> Self:
        """Read labels and detector; no picture is read yet.

        Args:
            request: which labels, which detector.
            profiles: of the degraded and of the reference images.
            seed: of acquisitions and intervals.
            cache: of what is found.

        Raises:
            BeersError: a folder, labels, classes or a detector that cannot be used, or pycocotools is not there.
        """
        require_library()
        detector = open_detector(request.file)
        subjects, remarks = read_subjects(detector.names, request.classes, request.images)
        cut = [detector.flag] if detector.flag else []
        study = Study(detector, request.file, subjects, seed, cache)
        return cls(study, Sensors(*profiles), (*cut, *remarks))

    @property
    def files(self) -> list[Path]:
        """The detector's and the pictures'."""
        return [self.study.file, *(subject.path for subject in self.study.subjects if subject.path)]

    @cached_property
    def pixels(self) -> int:
        """Of all acquisitions together."""
        sizes = [image_size_px(path) for path in self.files[1:]]
        return sum(height * width for height, width in sizes) // self.sensors.oversampling**2

    def find(self, name: str, content: str) -> Detected | None:
        """The kept score of a row, None where there is none."""
        return self.study.cache.find("detection", self._key(name, content), Detected)

    def ticks(self, rows: int) -> int:
        """How often `measure` calls its tick for so many rows."""
        return len(self.study.subjects) + rows

    def measure(self, contents: Contents, restores: Mapping[str, Restore], tick: Callable[[], None]) -> None:
        """Look at every scene in every row, score what is found, and keep it.

        Args:
            contents: of the rows.
            restores: how each variant among them restores.
            tick: called once a scene and once a row.
        """
        methods = {name: _method(name, restores) for name in contents}
        keys = {name: self.study.key(name, content, self.sensors) for name, content in contents.items()}
        found: dict[str, list[Boxes]] = {name: [] for name in contents}
        for number in range(len(self.study.subjects)):
            view = self.study.view(self.sensors, number)  # acquired once for all rows, and let go of after them
            for name, key in keys.items():
                found[name].append(self.study.found(view, methods[name], key))
            tick()
        for name, boxes in found.items():
            score = Detected.of(self.study.match(boxes), self.study.seed)
            self.study.cache.keep("detection", self._key(name, contents[name]), score)
            tick()

    def notes(self) -> tuple[str, ...]:
        """What a reader of the figure must know, once all is measured."""
        ends = {name: found.figure for name, content in BESIDE.items() if (found := self.find(name, content))}
        beside = ", ".join(f"{name} {figure} %" for name, figure in ends.items())
        scenes = f"{len(self.study.subjects)} labelled images as {self.sensors.degraded.name} acquires them"
        warning = warning_of(len({subject.site for subject in self.study.subjects}))
        return (
            f"mAP50: average precision at an overlap of half, mean over classes, of one fixed detector on {scenes}.",
            f"The same detector on the same images, measured: {beside}.",
            "Points differ in it where the interval of their paired difference over sites leaves 0 out.",
            *([f"mAP50: {warning}"] if warning else []),
            *self.remarks,
        )

    def _key(self, name: str, content: str) -> Key:
        return {**self.study.key(name, content, self.sensors), "labels": self._labels, "code": code_digest(__name__)}

    @cached_property
    def _labels(self) -> str:
        """Digest of the scenes in their order, of their sites, and of what is labelled on them."""
        parts = ("corners", "classes", "ignored")
        labels = [[getattr(each.truth, part).tolist() for part in parts] for each in self.study.subjects]
        return digest_of([labels, [[each.digest, each.site] for each in self.study.subjects]])


def _method(name: str, restores: Mapping[str, Restore]) -> Method | None:
    """None stands for the reference; degraded images are left as they are."""
    return None if name == REFERENCE else Method(name, restores.get(name, lambda dn: dn), "")
