"""What a fixed detector finds on the same scenes: as the reference sensor sees them, degraded, and restored.

scene -> acquisition, whole -> restoration -> one display for all, stretched as the reference asks -> detector ->
boxes back on the scene -> scores. What was found on a picture is kept as soon as it is there: a run that was stopped
goes on where it was.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from deploy.cache import Cache, Key, code_digest
from deploy.detection.boxes import Boxes
from deploy.detection.detectors import Detector
from deploy.detection.differences import Differences, differences
from deploy.detection.matching import Image, Matched, match
from deploy.detection.subjects import Subject
from deploy.methods import AT, method_named
from deploy.networks import Say, conditioned, network_file
from model.evaluation.methods import DEGRADED, Method
from model.io.files import sha256
from model.io.pictures import Stretch, stretch_of
from model.progress import steps
from model.simulator.acquire import acquire_padded
from model.simulator.detector import Draw
from profiles.sensor import SensorProfile, numbers_of
from profiles.sensor_file import load_sensor

REFERENCE = "reference"
"""The row of the scenes as the reference sensor sees them."""


@dataclass(frozen=True)
class Sensors:
    """The sensor that degrades, and the one that is aimed at, in its units."""

    degraded: SensorProfile
    reference: SensorProfile

    @property
    def oversampling(self) -> int:
        """Scene pixels per pixel."""
        return int(self.degraded.oversampling.low)


@dataclass(frozen=True)
class View:
    """A scene in front of two sensors.

    Attributes:
        subject: the scene.
        sensors: that acquire it.
        draw: of the noise, and of the sensors within their profiles.
    """

    subject: Subject
    sensors: Sensors
    draw: Draw

    @cached_property
    def reference(self) -> np.ndarray:
        """Digital numbers (h, w) of the reference sensor."""
        return self._acquired(self.sensors.reference, REFERENCE)

    @cached_property
    def degraded(self) -> np.ndarray:
        """Digital numbers (h, w) of the degraded one."""
        return self._acquired(self.sensors.degraded, DEGRADED)

    @cached_property
    def display(self) -> Stretch:
        """How every row's image of this scene is shown."""
        return stretch_of(self.reference)

    def shown(self, method: Method | None) -> np.ndarray:
        """What a detector is given, (h, w, 3) float32 in 0 to 1: restored by a method; the reference for None."""
        return self.display.to_srgb(self.reference if method is None else method.restore(self.degraded))

    def _acquired(self, profile: SensorProfile, role: str) -> np.ndarray:
        sensor, radiance = profile.draw(self.draw.generator("sensor")), self.subject.radiance(profile.nominal())
        return acquire_padded(radiance, sensor, self.sensors.oversampling, self.draw, role).numpy()


@dataclass(frozen=True)
class Found:
    """Boxes that a detector found on a picture, in scene pixels."""

    boxes: Boxes

    def to_json(self) -> dict[str, object]:
        """What JSON can hold, for the cache."""
        return {name: getattr(self.boxes, name).tolist() for name in ("corners", "classes", "scores")}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """Boxes as `to_json` wrote them; raises KeyError, TypeError or ValueError on anything else."""
        return cls(Boxes.of(stored["corners"], stored["classes"], stored["scores"]))


@dataclass(frozen=True)
class Comparison:
    """What was found under one sensor.

    Attributes:
        sensors: as they are stated.
        methods: by the names of the rows; None is the reference, which is first.
        views: of the subjects, in their order.
        found: boxes on each of them, by row.
        matched: the same beside what is labelled.
        differences: scores and their intervals.
    """

    sensors: Sensors
    methods: Mapping[str, Method | None]
    views: Sequence[View]
    found: Mapping[str, Sequence[Boxes]]
    matched: Mapping[str, Matched]
    differences: Differences

    @property
    def name(self) -> str:
        """Of the sensor that degrades."""
        return self.sensors.degraded.name


@dataclass(frozen=True)
class Study:
    """What all comparisons share.

    Attributes:
        detector: that is shown the pictures.
        file: of the detector.
        subjects: labelled scenes.
        seed: of acquisitions and intervals.
        cache: of what was found.
    """

    detector: Detector
    file: Path
    subjects: Sequence[Subject]
    seed: int
    cache: Cache

    def compare(self, sensors: Sensors, methods: Mapping[str, Method | None]) -> Comparison:
        """Show the detector every scene in every row, and score what it finds.

        Args:
            sensors: that acquire the scenes.
            methods: by row, as `rows_of` gives them.

        Raises:
            BeersError: a picture that cannot be used.
        """
        found = self.look(sensors, methods)
        matched = {name: self.match(boxes) for name, boxes in found.items()}
        scored = differences(matched, np.random.default_rng(self.seed))
        return Comparison(sensors, methods, self.views(sensors), found, matched, scored)

    def views(self, sensors: Sensors) -> list[View]:
        """Every scene in front of the sensors; nothing is acquired before it is asked for."""
        return [self.view(sensors, number) for number in range(len(self.subjects))]

    def view(self, sensors: Sensors, number: int) -> View:
        """One scene by its number in front of the sensors."""
        return View(self.subjects[number], sensors, Draw(self.seed, number))

    def look(self, sensors: Sensors, methods: Mapping[str, Method | None]) -> dict[str, list[Boxes]]:
        """What the detector finds on every scene, by row; None stands for the reference."""
        keys = {name: self.key(name, network_digest(name, sensors.degraded), sensors) for name in methods}
        found: dict[str, list[Boxes]] = {name: [] for name in methods}
        views = self.views(sensors)[::-1]
        with steps(f"detecting, {sensors.degraded.name}", len(views) * len(methods)) as bar:
            while views:
                view = views.pop()  # and its acquisitions with it: those of thousands would fill the memory
                for name, method in methods.items():
                    found[name].append(self.found(view, method, keys[name]))
                    bar.advance(1, name)
        return found

    def match(self, found: Sequence[Boxes]) -> Matched:
        """Boxes on every scene beside what is labelled."""
        pairs = zip(self.subjects, found, strict=True)
        return match([Image(subject.truth, boxes, subject.site) for subject, boxes in pairs], self.detector.names)

    def found(self, view: View, method: Method | None, key: Key) -> Boxes:
        """Boxes in scene pixels on one scene, kept under the `key` of its row; the reference for None.

        Raises:
            BeersError: a picture that cannot be used.
        """

        def detect() -> Found:
            boxes = self.detector.detect(view.shown(method))
            return Found(boxes.at(boxes.corners * view.sensors.oversampling))

        scene = {"scene": view.subject.digest, "number": view.draw.patch}
        return self.cache.make("found", {**key, **scene}, Found, detect).boxes

    def key(self, name: str, network: str, sensors: Sensors) -> dict[str, object]:
        """Everything besides the scene that what is found under a row depends on.

        Args:
            name: of the row.
            network: digest of what the pictures of a network depend on; empty of others.
            sensors: that acquire the scenes.
        """
        numbers = [numbers_of(profile) for profile in (sensors.degraded, sensors.reference)]
        return {
            "row": name,
            "network": network,
            "sensors": numbers,
            "detector": self._file_digest,
            "size_px": self.detector.size_px,
            "seed": self.seed,
            "code": code_digest(__name__),
        }

    @cached_property
    def _file_digest(self) -> str:
        return sha256(self.file)


def rows_of(sensors: Sensors, names: Sequence[str], say: Say) -> dict[str, Method | None]:
    """The rows of a comparison: the reference, then each method of that name (`deploy.methods`).

    Args:
        sensors: that methods know.
        names: of methods, the degraded images among them.
        say: is told what of the sensor lies outside the range that a network was trained for.

    Raises:
        BeersError: a method that cannot be had.
    """
    return {REFERENCE: None} | {name: method_named(name, sensors.degraded, sensors.reference, say) for name in names}


def network_digest(name: str, degraded: SensorProfile) -> str:
    """SHA-256 of the file of a method that is a network, told as `method_named` tells it; nothing of others."""
    network, _, other = name.partition(AT)
    path = Path(network)
    if conditioned(path) is not None:
        return sha256(network_file(path, load_sensor(other) if other else degraded))
    return sha256(path) if path.is_file() else ""
