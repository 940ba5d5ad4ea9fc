"""Synthetic scenes with labels, as the study of detectors takes them."""

from collections.abc import Mapping, Sequence

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.studies.detection.detector import class_numbers
from beers_deploy.studies.detection.study import LabelledScene, left_out
from benchmarks.detector.scenes import CLASSES, synthetic_scene

SIDE_PX = 768
"""Of a synthetic scene: 256 pixels a side of a sensor that makes one of three, the input of the
small detector.
"""


def synthetic_scenes(
    count: int, seed: int, names: Sequence[str], given: Mapping[str, str]
) -> tuple[list[LabelledScene], list[str]]:
    """The first synthetic scenes of a seed, each a site of its own, and sentences on what they are.

    Args:
        count: how many; the same scenes however many there are.
        seed: other for other scenes.
        names: of the classes that the detector knows.
        given: of them by synthetic ones, where letters do not match.
    """
    numbers = class_numbers(CLASSES, names, given)
    scenes = []
    with steps("drawing scenes", count) as bar:
        for number in range(count):
            scenes.append(synthetic_labelled(number, seed, numbers))
            bar.advance()
    note = f"The {count} scenes are synthetic, each a site of its own: no photographs."
    return scenes, [note, *left_out(CLASSES, numbers)]


def synthetic_labelled(number: int, seed: int, classes: np.ndarray) -> LabelledScene:
    """The synthetic scene of a number; no two numbers or seeds share a generator.

    Args:
        number: of the scene.
        seed: other for other scenes of the same numbers.
        classes: the synthetic classes as the detector's, as `class_numbers` gives them.
    """
    radiance, truth = synthetic_scene(np.random.default_rng([seed, number]), SIDE_PX, SIDE_PX)
    name = f"synthetic {number}"
    return LabelledScene(name, name, truth.renamed(classes), None, lambda _: radiance)
