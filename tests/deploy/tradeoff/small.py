"""Real studies of next to nothing: few patches, targets and sensors, one quality of the chain, one peer."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest

from deploy.tradeoff import measurements, methods, selection
from deploy.tradeoff.host_time import Times
from model.evaluation import sweep, targets
from model.evaluation.methods import Restore


@contextmanager
def small_studies() -> Iterator[None]:
    """Less of everything, and a clock that always says the same."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in (
            (targets, "ANGLES_DEG", (5.0, 8.0)),
            (targets, "REPEATS", 1),
            (sweep, "SHARPNESS", (0.07, 0.05, 0.03)),  # those that are also known wrongly
            (sweep, "NOISE", ((30.0, 80.0),)),
            (methods, "PATCHES", 2),
            (methods, "PATCH_PX", 32),
            (selection, "QUALITIES", ("fast",)),
            (selection, "PEERS", ("nl-means",)),
            (measurements, "time_variants", _steady),
        ):
            patch.setattr(module, name, value)
        yield


def _steady(methods: Sequence[Restore], tile: np.ndarray, tick: Callable[[], None]) -> list[Times]:
    tick()
    return [Times("one", (0.1, 0.2, 0.1), (0.1, 0.1, 0.1), tile.size) for _ in methods]
