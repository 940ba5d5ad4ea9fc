"""What a detector finds on labelled images that a variant restored: mAP50, a quality beside PSNR.

It is the one place of the trade-off that knows the detection study.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy.model.io.files import sha256
from beers_deploy.model.shipped import DETECTOR
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.studies.detection.average_precision import find_hits, interval, map50, site_weights
from beers_deploy.studies.detection.detector import Detector, open_detector, parse_classes
from beers_deploy.studies.detection.study import LabelledScene, SensorPair, acquired, labelled_scenes
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.tradeoff.measure import Benchmark, key_of


@dataclass(frozen=True)
class Labelled:
    """Labelled scenes and the detector that looks at them.

    Attributes:
        detector: that is shown the restored images.
        scenes: labelled.
        sensors: that acquire them.
        seed: of acquisitions and of the bootstrap.
        digest: of detector, scenes, labels and sensors.
        notes: what a reader must know of labels and detector.
    """

    detector: Detector
    scenes: Sequence[LabelledScene]
    sensors: SensorPair
    seed: int
    digest: str
    notes: Sequence[str]

    @classmethod
    def open(cls, images: Path, detector: Path | None, classes: str | None, benchmark: Benchmark) -> "Labelled":
        """Read the labels and open the detector; no image is read yet.

        Args:
            images: folder of labelled images.
            detector: ONNX file; the embedded one if None.
            classes: labelled classes under the detector's names, as the user writes them.
            benchmark: whose sensors acquire the scenes, and whose seed draws.
        """
        file = detector or DETECTOR
        opened = open_detector(file)
        scenes, notes = labelled_scenes(opened.names, parse_classes(classes) if classes else {}, images)
        files = [sha256(each.path) for each in scenes if each.path]
        labels = [(each.site, each.truth.corners.tolist(), each.truth.classes.tolist()) for each in scenes]
        sensors, seed = SensorPair(benchmark.degraded, benchmark.reference), benchmark.seed
        digest = key_of(detector=sha256(file), files=files, labels=labels, seed=seed, sensors=sensors)
        return cls(opened, scenes, sensors, seed, digest, [each for each in (opened.flag, *notes) if each])

    def measure(self, method: Method) -> dict[str, object]:
        """mAP50 of the detector on every scene as a method restores it, and its interval over sites."""
        found = [each.boxes(self.detector, method) for each in acquired(self.scenes, self.sensors, self.seed)]
        hits = find_hits([scene.truth for scene in self.scenes], found, len(self.detector.names))
        sites = [scene.site for scene in self.scenes]
        values = map50(hits, site_weights(sites, self.seed))
        value = None if np.isnan(values[0]) else float(values[0])
        return {"value": value, "interval": interval(values, len(set(sites)))}

    def figure(self, stored: Mapping[str, Any]) -> Figure:
        """What `measure` gave, in %."""
        if stored["value"] is None:
            return unavailable("%", "no labelled object")
        sites, ends = len({each.site for each in self.scenes}), stored["interval"]
        source = f"{len(self.scenes)} labelled images of {sites} sites, interval by bootstrap over sites"
        return measured(100 * stored["value"], "%", source, (100 * ends[0], 100 * ends[1]) if ends else None)
