"""Real but tiny studies: few patches, one chain, no other library, and constant times."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from beers_deploy.restoration.method import Restore
from beers_deploy.studies.tradeoff import measure, run


@contextmanager
def small_studies() -> Iterator[None]:
    """Reduce the patches, chains and baselines of a study, and fix its times."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in (
            (measure, "PATCHES", 2),
            (measure, "PATCH_PX", 32),
            (run, "QUALITIES", ("fast",)),
            (run, "BASELINES", ()),
            (measure, "host_times", _steady),
        ):
            patch.setattr(module, name, value)
        yield


def _steady(restores: Iterable[Restore], _tile: np.ndarray) -> list[list[float]]:
    return [[0.1, 0.2, 0.1] for _ in restores]
