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
from beers_deploy.profiles.sensor_file import load_sensor, reference_for
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.results import Table, print_rows
from beers_deploy.studies.detection.average_precision import find_hits, score
from beers_deploy.studies.detection.boxes import Letterbox
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.scenes import CLASSES
from beers_deploy.studies.detection.study import (
    REFERENCE,
    AcquiredScene,
    LabelledScene,
    SensorPair,
    acquired,
    synthetic_labelled,
    synthetic_scenes,
)
from beers_deploy.studies.detection.tables import GAIN, PERCENT, POINTS, REGAINED
from beers_deploy.studies.evaluation.methods import DEGRADED, Method, method_named
from benchmarks.detector.network import detector_to_onnx
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
        found = [each.boxes(detector, self.method) for each in acquired(scenes, self.sensors, seed)]
        hits = find_hits([scene.truth for scene in scenes], found, len(CLASSES))
        figures = score(hits, CLASSES, np.ones((1, len(scenes)), np.int64))
        return {shown: float(figures[key][0]) for shown, key in KEYS.items()}


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
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    recipes = [replace(RECIPE, steps=given.steps, seed=seed) for seed in range(given.seeds)]
    rows = conditions(given.sensor.split(","), given.method)
    files = train_missing(rows, recipes, given.scenes, given.seed, given.folder)
    scenes, _ = synthetic_scenes(given.drawn, given.seed, CLASSES, {})
    scored = {
        row.name: [row.scores(file, scenes, given.seed) for file in files[row.name]] for row in rows
    }
    made = retrained_rows(scored)
    print_rows(TABLE, made)
    Table("retrain", vars(given), (), tuple(made)).save(given.folder / "figures.json")


def conditions(sensors: Sequence[str], method: str) -> list[Condition]:
    """The reference, then degraded and restored images of each sensor."""
    found: list[Condition] = []
    for name in sensors:
        degraded = load_sensor(name)
        pair = SensorPair(degraded, reference_for(degraded))
        if not found:
            found.append(Condition(REFERENCE, pair, None))
        methods = (method_named(each, pair.degraded, pair.reference) for each in (DEGRADED, method))
        found += [Condition(f"{each.name}, {name}", pair, each) for each in methods]
    return found


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
        row.name: [folder / f"{row.name.replace(', ', '-')}-{each.seed}.onnx" for each in recipes]
        for row in rows
    }
    missing = [
        (row, recipe, file)
        for row in rows
        for recipe, file in zip(recipes, files[row.name], strict=True)
        if not file.exists()
    ]
    wanted = {row.name: row for row, *_ in missing}
    pictures = training_pictures(list(wanted.values()), scenes if wanted else 0, seed)
    with steps("training detectors", sum(recipe.steps for _, recipe, _ in missing)) as bar:
        for row, recipe, file in missing:
            network = train_detector(
                pictures[row.name], len(CLASSES), recipe, lambda _: bar.advance()
            )
            save_onnx(detector_to_onnx(network, CLASSES, SIDE_PX, {"row": row.name}), file)
    return files


def training_pictures(
    rows: Sequence[Condition], scenes: int, seed: int
) -> dict[str, list[Picture]]:
    """What the detectors are trained on, by row: each scene is drawn once for all."""
    found: dict[str, list[Picture]] = {row.name: [] for row in rows}
    with steps("drawing scenes to train on", scenes) as bar:
        for number in range(FIRST, FIRST + scenes):
            scene = synthetic_labelled(number, seed, np.arange(len(CLASSES)))
            for row in rows:
                seen = AcquiredScene(scene, row.sensors, Draw(seed, number))
                found[row.name].append(picture_from(seen, row.method))
            bar.advance()
    return found


def picture_from(seen: AcquiredScene, method: Method | None) -> Picture:
    """What a detector is trained on: an image as it would be shown, in its square input, and the
    boxes on it.
    """
    rgb = seen.shown(method)
    truth = seen.scene.truth
    height, width, _ = rgb.shape
    box = Letterbox(height, width, SIDE_PX)
    return picture_of(
        box.image(rgb), box.to_input(truth.corners / seen.sensors.oversampling), truth.classes
    )


def retrained_rows(scored: Mapping[str, Sequence[Mapping[str, float]]]) -> list[Row]:
    """Means over seeds, their spread as the interval; gains and shares of rows that were restored.

    Args:
        scored: by row, reference first, then a degraded and a restored one for each sensor; figures
            of each seed.
    """
    ap50 = {name: np.array([one["mAP50"] for one in each]) for name, each in scored.items()}
    names = list(scored)
    made = list[Row]()
    for number, name in enumerate(names):
        figures = {shown: _figure([each[shown] for each in scored[name]]) for shown in KEYS}
        if number and number % 2 == 0:
            before = ap50[names[number - 1]]
            figures[GAIN] = _figure(list(ap50[name] - before), POINTS)
            figures[REGAINED] = _share(ap50[names[0]], before, ap50[name])
        made.append(Row(TABLE, name, figures))
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


if __name__ == "__main__":
    main()
