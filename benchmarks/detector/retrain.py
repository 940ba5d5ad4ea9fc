"""The paper's protocol: the embedded detector is trained for each row anew, on that row's own
pictures.

    OMP_NUM_THREADS=1 python -m benchmarks.detector.retrain retrained/

Five rows: the reference, and degraded and restored images of two sensors. Each is trained from
drawn weights on synthetic scenes that no study looks at, with several seeds, and scored on its own
row's images of other scenes. A detector whose file lies in the folder is not trained again.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.results import Table
from beers_deploy.studies.detection.average_precision import find_hits, score
from beers_deploy.studies.detection.boxes import Letterbox
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.study import (
    REFERENCE,
    AcquiredScene,
    LabelledScene,
    SensorPair,
    acquired,
)
from beers_deploy.studies.detection.tables import GAIN, PERCENT, POINTS, REGAINED
from beers_deploy.studies.evaluation.methods import DEGRADED, Method, method_named
from benchmarks.detector.labelled import synthetic_labelled, synthetic_scenes
from benchmarks.detector.network import detector_to_onnx
from benchmarks.detector.scenes import CLASSES
from benchmarks.detector.training import DetectorRecipe, Picture, picture_of, train_detector

TABLE = "detector retrained for each row"
SIDE_PX = 256
RECIPE = DetectorRecipe(steps=600, batch=8, precision="bfloat16")
FIRST = 1_000_000
"""Number of the first scene of training: no study draws so many."""
KEYS = {
    "mAP50": "mAP50",
    "mAP50-95": "mAP50-95",
    "precision": "own precision",
    "recall": "own recall",
}


@dataclass(frozen=True)
class Condition:
    """A row: whose images the detector is trained and tested on.

    Attributes:
        name: of the row.
        sensors: that acquire.
        method: that restores; None for the reference.
    """

    name: str
    sensors: SensorPair
    method: Method | None

    def scores(self, file: Path, scenes: Sequence[LabelledScene], seed: int) -> dict[str, float]:
        """What the detector of a file finds on this row's images of the scenes."""
        detector = open_detector(file)
        predictions = [
            scene.boxes(detector, self.method) for scene in acquired(scenes, self.sensors, seed)
        ]
        hits = find_hits([scene.truth for scene in scenes], predictions, len(CLASSES))
        figures = score(hits, CLASSES, np.ones((1, len(scenes)), np.int64))
        return {title: float(figures[key][0]) for title, key in KEYS.items()}


def main() -> None:
    """Train what the folder lacks, score all, print the rows and write them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path, help="of the trained detectors and of figures.json")
    parser.add_argument("--sensor", default="dior-medium,dior-high")
    parser.add_argument("--method", default="convbeers-s-int8", help="what restores")
    parser.add_argument("--scenes", type=int, default=128, help="that each detector is trained on")
    parser.add_argument("--drawn", type=int, default=24, help="scenes that all are scored on")
    parser.add_argument("--steps", type=int, default=RECIPE.steps)
    parser.add_argument("--seeds", type=int, default=3, help="detectors a row")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    recipes = [replace(RECIPE, steps=arguments.steps, seed=seed) for seed in range(arguments.seeds)]
    rows = conditions(arguments.sensor.split(","), arguments.method)
    files = train_missing(rows, recipes, arguments.scenes, arguments.seed, arguments.folder)
    scenes, _ = synthetic_scenes(arguments.drawn, arguments.seed, CLASSES, {})
    scored = {
        row.name: [row.scores(file, scenes, arguments.seed) for file in files[row.name]]
        for row in rows
    }
    table = Table("retrain", vars(arguments), rows=tuple(retrained_rows(scored)))
    table.print()
    table.save(arguments.folder / "figures.json")


def conditions(sensors: Sequence[str], method: str) -> list[Condition]:
    """The reference, then degraded and restored images of each sensor."""
    result: list[Condition] = []
    for name in sensors:
        degraded = Sensor.load(name)
        pair = SensorPair(degraded, degraded.reference)
        if not result:
            result.append(Condition(REFERENCE, pair, None))
        methods = (method_named(word, pair.degraded, pair.reference) for word in (DEGRADED, method))
        result += [Condition(f"{candidate.name}, {name}", pair, candidate) for candidate in methods]
    return result


def train_missing(
    rows: Sequence[Condition],
    recipes: Sequence[DetectorRecipe],
    scenes: int,
    seed: int,
    folder: Path,
) -> dict[str, list[Path]]:
    """The files of all detectors, by row, after the training of those that are not in the folder.

    Args:
        rows: whose pictures they are trained on.
        recipes: one a detector of a row.
        scenes: how many each is trained on.
        seed: of the scenes.
        folder: of the files.
    """
    files = {
        row.name: [
            folder / f"{row.name.replace(', ', '-')}-{recipe.seed}.onnx" for recipe in recipes
        ]
        for row in rows
    }
    absent = list[tuple[Condition, DetectorRecipe, Path]]()
    for row in rows:
        pairs = zip(recipes, files[row.name], strict=True)
        absent += [(row, recipe, file) for recipe, file in pairs if not file.exists()]
    needed = {row.name: row for row, *_ in absent}
    pictures = training_pictures(list(needed.values()), scenes if needed else 0, seed)
    with steps("training detectors", sum(recipe.steps for _, recipe, _ in absent)) as bar:
        for row, recipe, file in absent:
            network = train_detector(
                pictures[row.name], len(CLASSES), recipe, lambda _: bar.advance()
            )
            save_onnx(detector_to_onnx(network, CLASSES, SIDE_PX, {"row": row.name}), file)
    return files


def training_pictures(
    rows: Sequence[Condition], scenes: int, seed: int
) -> dict[str, list[Picture]]:
    """What the detectors are trained on, by row: each scene is drawn once for all."""
    pictures: dict[str, list[Picture]] = {row.name: [] for row in rows}
    with steps("drawing scenes to train on", scenes) as bar:
        for number in range(FIRST, FIRST + scenes):
            scene = synthetic_labelled(number, seed, np.arange(len(CLASSES)))
            for row in rows:
                acquired_scene = AcquiredScene(scene, row.sensors, Draw(seed, number))
                pictures[row.name].append(picture_from(acquired_scene, row.method))
            bar.advance()
    return pictures


def picture_from(acquired_scene: AcquiredScene, method: Method | None) -> Picture:
    """What a detector is trained on: an image as it would be shown, in its square input, and the
    boxes on it.
    """
    rgb = acquired_scene.shown(method)
    truth = acquired_scene.scene.truth
    height, width, _ = rgb.shape
    box = Letterbox(height, width, SIDE_PX)
    return picture_of(
        box.image(rgb),
        box.to_input(truth.corners / acquired_scene.sensors.oversampling),
        truth.classes,
    )


def retrained_rows(scored: Mapping[str, Sequence[Mapping[str, float]]]) -> list[Row]:
    """Means over seeds, their spread as the interval; gains and shares of rows that were restored.

    Args:
        scored: by row, reference first, then a degraded and a restored one for each sensor; figures
            of each seed.
    """
    ap50 = {name: np.array([one["mAP50"] for one in runs]) for name, runs in scored.items()}
    names = list(scored)
    rows = list[Row]()
    for number, name in enumerate(names):
        figures = {title: _figure([run[title] for run in scored[name]]) for title in KEYS}
        if number and number % 2 == 0:
            before = ap50[names[number - 1]]
            figures[GAIN] = _figure(list(ap50[name] - before), POINTS)
            figures[REGAINED] = _share(ap50[names[0]], before, ap50[name])
        rows.append(Row(TABLE, name, figures))
    return rows


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


if __name__ == "__main__":
    main()
