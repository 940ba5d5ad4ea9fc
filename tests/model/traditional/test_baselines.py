"""Tests that scikit-image's restorations beat their input, not the pipeline, on any shape."""

import pytest
import torch
from torch import Tensor

from beers_deploy.model.traditional.baselines import BASELINES
from beers_deploy.model.traditional.pipeline import TraditionalPipeline
from tests.model.simulator.stages import NOMINAL, REFERENCE
from tests.model.traditional.test_pipeline import AcquiredPair, acquired_pair, psnr_db, restored_db

PIPELINE = TraditionalPipeline(NOMINAL, REFERENCE)


@pytest.fixture(scope="module")
def pair(camera: Tensor) -> AcquiredPair:
    return acquired_pair(camera, NOMINAL, REFERENCE)


@pytest.fixture(scope="module")
def pipeline_db(pair: AcquiredPair) -> float:
    return restored_db(pair, PIPELINE)


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_gains_decibels_and_is_worse_than_the_pipeline(
    name: str, pair: AcquiredPair, pipeline_db: float
) -> None:
    """A baseline with a wrong gain, shift or target MTF would flatter the pipeline."""
    restored = BASELINES[name](pair.degraded, PIPELINE)
    before, after = (psnr_db(image, pair.reference) for image in (pair.degraded, restored))
    assert before + 3 < after < pipeline_db
    assert float(restored.mean() / pair.degraded.mean()) == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("shape", [(37, 53), (14, 21)])
def test_any_shape_is_restored_within_range(
    name: str, shape: tuple[int, int], pair: AcquiredPair
) -> None:
    restored = BASELINES[name](pair.degraded[: shape[0], : shape[1]], PIPELINE)
    assert restored.shape == shape
    assert bool(torch.isfinite(restored).all())
    assert 0 <= float(restored.min()) <= float(restored.max()) <= 4095
