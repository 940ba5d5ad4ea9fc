"""Compare the detections of a fixed detector on the same scenes: as the reference sensor sees them,
degraded, and restored.

scene -> acquisition of the whole scene -> restoration -> one display for all rows, with the
reference's stretch -> detector -> boxes back on the scene -> average precision.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from beers_deploy.model.io.pictures import stretch_of
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import site_of
from beers_deploy.model.simulator.acquire import acquire_padded
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import read_scene
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.reference import reference_beside
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.studies.detection.average_precision import (
    Figures,
    Hits,
    find_hits,
    score_rows,
    site_weights,
)
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import Detector, class_numbers
from beers_deploy.studies.detection.labels import read_labelled
from beers_deploy.studies.evaluation.methods import DEGRADED, Method, method_named

REFERENCE = "reference"
"""The row of the scenes as the reference sensor sees them."""


@dataclass(frozen=True)
class LabelledScene:
    """A scene, and the objects in it that the detector knows.

    Attributes:
        name: the name of the file.
        site: its place; scenes of one site resemble one another.
        truth: labelled boxes in scene pixels, of the detector's classes.
        path: the path of the file; None for a scene in memory.
        radiance: returns the scene (H, W) in W/m2/sr/um. A picture's white is the full scale of the
            given sensor.
    """

    name: str
    site: str
    truth: Boxes
    path: Path | None
    radiance: Callable[[Instrument], np.ndarray]


@dataclass(frozen=True)
class SensorPair:
    """The degrading sensor, and the reference sensor converted to its units."""

    degraded: Sensor
    reference: Sensor

    @property
    def oversampling(self) -> int:
        """Scene pixels per pixel."""
        return int(self.degraded.oversampling.low)


@dataclass(frozen=True)
class AcquiredScene:
    """A scene in front of two sensors, under one draw of them and of the noise. It is acquired on
    demand.
    """

    scene: LabelledScene
    sensors: SensorPair
    draw: Draw

    @cached_property
    def reference(self) -> np.ndarray:
        """The digital numbers (h, w) of the reference sensor."""
        return self._acquired(self.sensors.reference, REFERENCE)

    @cached_property
    def degraded(self) -> np.ndarray:
        """The digital numbers (h, w) of the degrading sensor."""
        return self._acquired(self.sensors.degraded, DEGRADED)

    def shown(self, method: Method | None) -> np.ndarray:
        """Return the image for a detector, (h, w, 3) float32 in 0 to 1: restored by a method, or
        the reference for None.

        All rows of a scene are displayed in the same way, with the stretch of the reference.
        """
        # All rows of a scene share the stretch of the reference, so that contrast compares.
        dn = self.reference if method is None else method.restore(self.degraded)
        return stretch_of(self.reference).to_srgb(dn)

    def boxes(self, detector: Detector, method: Method | None) -> Boxes:
        """Return the detections on the image, in scene pixels. The arguments are those of
        `shown`.
        """
        detections = detector.detect(self.shown(method))
        return replace(detections, corners=detections.corners * self.sensors.oversampling)

    def _acquired(self, profile: Sensor, role: str) -> np.ndarray:
        sensor = profile.draw(self.draw.generator("sensor"))
        radiance = self.scene.radiance(profile.nominal())
        return acquire_padded(radiance, sensor, self.sensors.oversampling, self.draw, role)


@dataclass(frozen=True)
class Comparison:
    """The detections under one pair of sensors.

    Attributes:
        sensors: as they are stated.
        methods: by the names of the rows; None is the reference, which is first.
        scenes: in front of the sensors.
        boxes: the detections on each scene, by row.
        hits: which of them found an object, by row.
        figures: by row.
        confidence: the confidence at which precision and recall are sampled in every row.
        names: the names of the classes.
    """

    sensors: SensorPair
    methods: Mapping[str, Method | None]
    scenes: Sequence[AcquiredScene]
    boxes: Mapping[str, Sequence[Boxes]]
    hits: Mapping[str, Hits]
    figures: Mapping[str, Figures]
    confidence: float
    names: Sequence[str]

    @property
    def name(self) -> str:
        """The name of the degrading sensor."""
        return self.sensors.degraded.name

    @property
    def sites(self) -> int:
        """The number of different sites."""
        return len({acquired.scene.site for acquired in self.scenes})


def run_study(
    detector: Detector,
    scenes: Sequence[LabelledScene],
    sensors: Sequence[Sensor],
    methods: Sequence[str],
    *,
    reference: SensorLike | None = None,
    seed: int = 0,
) -> list[Comparison]:
    """Run a detector on the same scenes as the reference sees them, degraded and restored, under
    each sensor.

    Args:
        detector: the detector that runs on the images.
        scenes: labelled.
        sensors: the sensors of the degraded images.
        methods: names of the rows besides the reference, the degraded images among them.
        reference: profile of the reference images; None for the default one.
        seed: the seed of every random draw.
    """
    cases = []
    # A method that does not exist is refused before anything is detected.
    for profile in sensors:
        pair = SensorPair(profile, reference_beside(profile, reference))
        rows = {name: method_named(name, pair.degraded, pair.reference) for name in methods}
        cases.append((pair, rows))
    return [_compared(detector, scenes, pair, rows, seed) for pair, rows in cases]


def _compared(
    detector: Detector,
    scenes: Sequence[LabelledScene],
    sensors: SensorPair,
    methods: Mapping[str, Method],
    seed: int,
) -> Comparison:
    rows = {REFERENCE: None, **methods}
    boxes: dict[str, list[Boxes]] = {row: [] for row in rows}
    with steps(f"detecting, {sensors.degraded.name}", len(scenes) * len(rows)) as bar:
        # Each scene is released after its rows, because thousands would fill the memory.
        for scene in acquired(scenes, sensors, seed):
            for row, method in rows.items():
                boxes[row].append(scene.boxes(detector, method))
                bar.advance(1, row)
    names = detector.names
    truths = [scene.truth for scene in scenes]
    sites = [scene.site for scene in scenes]
    hits = {row: find_hits(truths, row_boxes, len(names)) for row, row_boxes in boxes.items()}
    scores = score_rows(hits, names, site_weights(sites, seed))
    return Comparison(
        sensors, rows, list(acquired(scenes, sensors, seed)), boxes, hits, *scores, names
    )


def acquired(
    scenes: Sequence[LabelledScene], sensors: SensorPair, seed: int
) -> Iterator[AcquiredScene]:
    """Yield every scene in front of the sensors. The noise depends on the seed and the scene's
    number.
    """
    for number, scene in enumerate(scenes):
        yield AcquiredScene(scene, sensors, Draw(seed, number))


def labelled_scenes(
    names: Sequence[str],
    mapping: Mapping[str, str],
    images: Path,
    labels: Path | None = None,
    split: str | None = None,
) -> tuple[list[LabelledScene], list[str]]:
    """Return the labelled pictures of a folder as scenes, which are read on demand, and sentences
    on what is left out.

    Args:
        names: the names of the classes that the detector knows.
        mapping: the detector's names by labelled ones, where letters do not match.
        images: as `read_labelled` accepts it.
        labels: their path, if not next to the pictures.
        split: the part of a tree.
    """
    labelled = read_labelled(images, labels, split)
    numbers = class_numbers(labelled.names, names, mapping)
    scenes = [_of_file(path, truth.renamed(numbers)) for path, truth in labelled.images]
    notes = [*labelled.notes]
    unknown = [name for name, number in zip(labelled.names, numbers, strict=True) if number < 0]
    if unknown:
        notes.append(
            f"Not known to the detector and left out: {', '.join(unknown)}. What it finds there "
            "counts as false."
        )
    return scenes, notes


def _of_file(path: Path, truth: Boxes) -> LabelledScene:
    # The call binds `path`: a lambda in a loop over the files would read the last of them.
    return LabelledScene(
        path.name, site_of(path.name), truth, path, lambda sensor: read_scene(path, sensor).radiance
    )
