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
from beers_deploy.profiles.reference import reference_for
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.studies.detection.average_precision import Figures, score_rows, site_weights
from beers_deploy.studies.detection.boxes import Boxes
from beers_deploy.studies.detection.detector import Detector, class_numbers
from beers_deploy.studies.detection.labels import read_labelled
from beers_deploy.studies.detection.matching import Hits, find_hits
from beers_deploy.studies.evaluation.methods import DEGRADED, Method, method_named

REFERENCE = "reference"
"""The row of the scenes as the reference sensor sees them."""


@dataclass(frozen=True)
class LabelledScene:
    """A scene with labelled objects, before any sensor acquires it.

    Attributes:
        name: the name of the file.
        site: the place of the scene; scenes of one site resemble one another.
        truth: the labelled boxes in scene pixels, of the classes that the detector knows.
        path: the path of the file; None for a scene in memory.
        radiance: reads the scene, and returns it as (H, W) in W/m2/sr/um. The white of a photograph
            is the full scale of the given instrument.
    """

    name: str
    site: str
    truth: Boxes
    path: Path | None
    radiance: Callable[[Instrument], np.ndarray]


@dataclass(frozen=True)
class SensorPair:
    """The two sensors that acquire each scene.

    Attributes:
        degraded: the profile of the sensor whose images are restored.
        reference: the profile of the better sensor, in the digital numbers of the first.
    """

    degraded: Sensor
    reference: Sensor

    @property
    def oversampling(self) -> int:
        """The number of scene pixels per pixel of both sensors, along either side."""
        return int(self.degraded.oversampling.low)


@dataclass(frozen=True)
class AcquiredScene:
    """A scene as two sensors acquire it. The images are simulated when they are first asked for.

    Attributes:
        scene: the scene with its labels.
        sensors: the profiles of the two sensors.
        draw: the key of the random draws: of each sensor from the ranges of its profile, and of the
            noise.
    """

    scene: LabelledScene
    sensors: SensorPair
    draw: Draw

    @cached_property
    def reference(self) -> np.ndarray:
        """The image of the reference sensor, digital numbers (h, w)."""
        return self._acquired(self.sensors.reference, REFERENCE)

    @cached_property
    def degraded(self) -> np.ndarray:
        """The image of the degrading sensor, digital numbers (h, w)."""
        return self._acquired(self.sensors.degraded, DEGRADED)

    def shown(self, method: Method | None) -> np.ndarray:
        """Return the image that a detector is shown.

        All images of a scene have the contrast stretch of the reference, so that they compare.

        Args:
            method: the method that restores the degraded image; None shows the reference image.

        Returns:
            The image (h, w, 3), float32 in 0 to 1.
        """
        dn = self.reference if method is None else method.restore(self.degraded)
        return stretch_of(self.reference).to_srgb(dn)

    def boxes(self, detector: Detector, method: Method | None) -> Boxes:
        """Run a detector on the image that `shown` returns.

        Args:
            detector: the detector.
            method: the method that restores the degraded image; None for the reference image.

        Returns:
            The detected boxes in scene pixels.
        """
        detections = detector.detect(self.shown(method))
        return replace(detections, corners=detections.corners * self.sensors.oversampling)

    def _acquired(self, profile: Sensor, role: str) -> np.ndarray:
        sensor = profile.draw(self.draw.generator("sensor"))
        radiance = self.scene.radiance(profile.nominal())
        return acquire_padded(radiance, sensor, self.sensors.oversampling, self.draw, role)


@dataclass(frozen=True)
class Comparison:
    """The results of a detector under one pair of sensors, on the same scenes shown in several ways
    (the rows): the reference, degraded and restored images.

    Attributes:
        sensors: the profiles of the two sensors.
        methods: the method of each row by its name; the reference is the first row, with None.
        scenes: the scenes as the sensors acquire them.
        boxes: for each row the detections on each scene, in scene pixels.
        hits: for each row what its detections found.
        figures: for each row its figures by name, on all images and on each bootstrap draw.
        confidence: the confidence at which precision and recall are sampled in every row.
        names: the names of the detector's classes.
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
        """The number of different sites of the scenes."""
        return len({acquired.scene.site for acquired in self.scenes})


def run_study(
    detector: Detector,
    scenes: Sequence[LabelledScene],
    sensors: Sequence[Sensor],
    methods: Sequence[str],
    *,
    reference: SensorLike | None = None,
    seed: int,
) -> list[Comparison]:
    """Measure how well a detector finds objects on reference, degraded and restored images of the
    same scenes.

    Args:
        detector: the detector.
        scenes: the scenes with their labels.
        sensors: the sensors of the degraded images, each compared by itself.
        methods: the names of the methods that make a row, the degraded input among them. The
            reference is a row in any case.
        reference: the profile of the reference images; None for the default one.
        seed: the seed of every random draw.

    Returns:
        The results under each sensor, in the order of `sensors`.

    Raises:
        OptionError: there is no such method.
    """
    cases: list[tuple[SensorPair, dict[str, Method | None]]] = []
    # A method that does not exist is refused before anything is detected.
    for profile in sensors:
        pair = SensorPair(profile, reference_for(profile, reference))
        named = {name: method_named(name, pair.degraded, pair.reference) for name in methods}
        cases.append((pair, {REFERENCE: None, **named}))
    names = detector.names
    truths = [scene.truth for scene in scenes]
    weights = site_weights([scene.site for scene in scenes], seed)
    compared = []
    for pair, rows in cases:
        boxes: dict[str, list[Boxes]] = {row: [] for row in rows}
        with steps(f"detecting, {pair.degraded.name}", len(scenes) * len(rows)) as bar:
            # Each scene is released after its rows, because thousands would fill the memory.
            for scene in acquired(scenes, pair, seed):
                for row, method in rows.items():
                    boxes[row].append(scene.boxes(detector, method))
                    bar.advance(1, row)
        hits = {row: find_hits(truths, row_boxes, len(names)) for row, row_boxes in boxes.items()}
        figures, confidence = score_rows(hits, names, weights)
        shown = list(acquired(scenes, pair, seed))
        compared.append(
            Comparison(
                sensors=pair,
                methods=rows,
                scenes=shown,
                boxes=boxes,
                hits=hits,
                figures=figures,
                confidence=confidence,
                names=names,
            )
        )
    return compared


def acquired(
    scenes: Sequence[LabelledScene], sensors: SensorPair, seed: int
) -> Iterator[AcquiredScene]:
    """Yield every scene as the sensors acquire it. The noise of a scene depends on the seed and on
    its index in `scenes`.
    """
    for number, scene in enumerate(scenes):
        yield AcquiredScene(scene, sensors, Draw(seed, number))


def labelled_scenes(
    names: Sequence[str],
    mapping: Mapping[str, str],
    images: Path,
    labels: Path | None,
    split: str | None,
) -> tuple[list[LabelledScene], list[str]]:
    """Read the labels of a folder of pictures, and return the pictures as scenes, whose pixels are
    read on demand.

    Args:
        names: the names of the classes that the detector knows.
        mapping: the detector's name by the labelled name, for classes whose names differ.
        images: the folder of the pictures, or the top of a folder tree of VOC or DIOR.
        labels: the folder or file of the labels; None searches next to the pictures.
        split: the name of a list of images in a tree of VOC or DIOR; None uses "test" if there is
            one.

    Returns:
        The scenes, and sentences for the reader of results on labels that are left out.

    Raises:
        OptionError: the labels cannot be read, or no labelled class is one of the detector's.
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
