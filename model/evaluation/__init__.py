"""Methods compared on the same pairs and targets: scores with intervals, by image and by site.

- `methods`: what a method is, and those that need no network;
- `pairs`: degraded and reference images, simulated or read; `targets`: edges and flat fields whose truth is known;
- `scores`: figures of one method; `run`: an evaluation of several, and the sweep over sensors.
"""

from model.evaluation.methods import Method
from model.evaluation.pairs import NamedPair, read_pairs, simulate_pairs
from model.evaluation.run import Evaluation, evaluate_methods, load_pairs
from model.evaluation.scores import Instruments, perceptual_distances

__all__ = [
    "Evaluation",
    "Instruments",
    "Method",
    "NamedPair",
    "evaluate_methods",
    "load_pairs",
    "perceptual_distances",
    "read_pairs",
    "simulate_pairs",
]
