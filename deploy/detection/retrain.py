"""The paper's protocol: the detector is trained for each row anew, on that row's own pictures.

Five rows: the reference, and degraded and restored images of two sensors. The embedded detector is trained from
drawn weights, on drawn scenes that no study looks at, with several seeds; each one is scored on its own row's images.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from deploy.cache import Cache, code_digest
from deploy.detection.boxes import Letterbox
from deploy.detection.classes import class_map
from deploy.detection.detectors import open_detector
from deploy.detection.rows import GAIN, PERCENT, POINTS, REGAINED
from deploy.detection.scores import score
from deploy.detection.study import REFERENCE, Sensors, Study, View, network_digest
from deploy.detection.subjects import Subject, drawn_subject
from deploy.methods import method_named
from deploy.networks import Say
from model.detection.export import detector_to_onnx
from model.detection.pictures import Picture, picture_of
from model.detection.scenes import CLASSES
from model.detection.training import DetectorRecipe, train_detector
from model.evaluation.methods import DEGRADED, Method
from model.progress import Steps, steps
from model.simulator.detector import Draw
from profiles.figures import Figure, Row, measured, unavailable
from profiles.sensor import numbers_of
from quant.onnx_file import save_onnx

TABLE = "detector retrained for each row"
SEEDS = 3
SCENES = 128
"""That a detector is trained on."""
SIDE_PX = 256
RECIPE = DetectorRecipe(steps=600, batch=8, precision="bfloat16")
FIRST = 1_000_000
"""Number of the first scene of training: no study draws so many."""


@dataclass(frozen=True)
class Condition:
    """A row: whose images the detector is trained and tested on.

    Attributes:
        name: of the row.
        sensors: that acquire.
        method: that restores; None for the reference.
        restorer: the method's name.
    """

    name: str
    sensors: Sensors
    method: Method | None
    restorer: str


def conditions(sensors: Sequence[Sensors], restorer: str, say: Say) -> list[Condition]:
    """The reference, then degraded and restored images of each sensor.

    Raises:
        BeersError: no such method.
    """
    found = [Condition(REFERENCE, sensors[0], None, REFERENCE)]
    for each in sensors:
        for name in dict.fromkeys((DEGRADED, restorer)):
            method = method_named(name, each.degraded, each.reference, say)
            found.append(Condition(f"{name}, {each.degraded.name}", each, method, name))
    return found


@dataclass(frozen=True)
class Retraining:
    """What all trainings share.

    Attributes:
        conditions: the rows.
        subjects: labelled drawn scenes to be scored on, of the classes of the embedded detector.
        seed: of the study.
        cache: of detectors and of what they found.
        recipe: of the trainings.
        scenes: how many each is trained on.
    """

    conditions: Sequence[Condition]
    subjects: Sequence[Subject]
    seed: int
    cache: Cache
    recipe: DetectorRecipe = RECIPE
    scenes: int = SCENES

    def run(self) -> list[Row]:
        """Train what the cache lacks and score it: the rows, means over the seeds."""
        self._train()
        scored = {one.name: [self._scores(one, seed) for seed in range(SEEDS)] for one in self.conditions}
        return retrained_rows(self.conditions, scored)

    def file(self, condition: Condition, seed: int) -> Path:
        """Where a trained detector is kept."""
        key = {
            "row": condition.restorer,
            "network": network_digest(condition.restorer, condition.sensors.degraded),
            "sensors": [numbers_of(each) for each in (condition.sensors.degraded, condition.sensors.reference)],
            "recipe": vars(replace(self.recipe, seed=seed)),
            "scenes": [self.seed, self.scenes],
            "code": code_digest(__name__),
        }
        return self.cache.path("detector", key, "onnx")

    def _train(self) -> None:
        missing = [
            (one, seed) for one in self.conditions for seed in range(SEEDS) if not self.file(one, seed).exists()
        ]
        if not missing:
            return
        pictures = self._pictures({one.name: one for one, _ in missing})
        with steps("training detectors", len(missing) * self.recipe.steps) as bar:
            for one, seed in missing:
                recipe, tick = replace(self.recipe, seed=seed), partial(_tick, bar, one.name)
                network = train_detector(pictures[one.name], len(CLASSES), recipe, tick)
                save_onnx(detector_to_onnx(network, CLASSES, SIDE_PX, {"row": one.name}), self.file(one, seed))

    def _pictures(self, wanted: Mapping[str, Condition]) -> dict[str, list[Picture]]:
        """What the detectors are trained on, by row: each scene is drawn once for all."""
        found: dict[str, list[Picture]] = {name: [] for name in wanted}
        with steps("drawing scenes to train on", self.scenes) as bar:
            for number in range(self.scenes):
                subject = drawn_subject(FIRST + number, self.seed, class_map(CLASSES, CLASSES))
                for name, one in wanted.items():
                    view = View(subject, one.sensors, Draw(self.seed, FIRST + number))
                    found[name].append(picture_from(view, one.method))
                bar.advance()
        return found

    def _scores(self, condition: Condition, seed: int) -> dict[str, float]:
        file = self.file(condition, seed)
        study = Study(open_detector(file), file, self.subjects, self.seed, self.cache)
        found = study.look(condition.sensors, {condition.restorer: condition.method})
        return score(study.match(found[condition.restorer])).figures()


def _tick(bar: Steps, name: str, _loss: float) -> None:
    bar.advance(1, name)


def picture_from(view: View, method: Method | None) -> Picture:
    """What a detector is trained on: an image as it would be shown, in its square input, and the boxes on it."""
    rgb = view.shown(method)
    height, width, _ = rgb.shape
    box, truth = Letterbox(height, width, SIDE_PX), view.subject.truth
    return picture_of(box.image(rgb), box.to_input(truth.corners / view.sensors.oversampling), truth.classes)


KEYS = {"mAP50": "ap50", "mAP50-95": "ap", "precision": "own precision", "recall": "own recall"}


def retrained_rows(rows: Sequence[Condition], scored: Mapping[str, Sequence[Mapping[str, float]]]) -> list[Row]:
    """Means over seeds, their spread as the interval; gains and shares of rows that were restored.

    Args:
        rows: reference first, then a degraded one and a restored one for each sensor.
        scored: figures of each row's detectors, a seed each.
    """
    ap = {name: np.array([one["ap50"] for one in each]) for name, each in scored.items()}
    made = []
    for number, one in enumerate(rows):
        figures = {shown: _figure([each[key] for each in scored[one.name]]) for shown, key in KEYS.items()}
        if one.restorer not in (REFERENCE, DEGRADED):
            before = ap[rows[number - 1].name]
            figures[GAIN] = _figure(list(ap[one.name] - before), POINTS)
            figures[REGAINED] = _share(ap[REFERENCE], before, ap[one.name])
        made.append(Row(TABLE, one.name, figures))
    return made


def _figure(values: Sequence[float], unit: str = PERCENT) -> Figure:
    percents = [100 * value for value in values]
    source = f"mean of {len(values)} seeds, between brackets the least and the largest"
    return measured(float(np.mean(percents)), unit, source, (min(percents), max(percents)))


def _share(reference: np.ndarray, degraded: np.ndarray, restored: np.ndarray) -> Figure:
    """Of the mean loss; unavailable where seeds differ by more than was lost."""
    if degraded.max() >= reference.min():
        return unavailable(PERCENT, "no loss that can be told from what seeds differ by")
    share = (restored.mean() - degraded.mean()) / (reference.mean() - degraded.mean())
    return measured(100 * float(share), PERCENT, f"of means over {len(reference)} seeds")
