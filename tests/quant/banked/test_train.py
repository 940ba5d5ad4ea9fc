"""A family's body trained in whole numbers: it computes what the files of its sensors do, and learns."""

from itertools import repeat

import numpy as np
import pytest

from beers_deploy.model.bank import bank_of_vector
from beers_deploy.model.io.tensors import Weights
from beers_deploy.model.simulator.procedural import draw_scenes
from beers_deploy.quant.banked.calibrate import bank_results, quantise_family
from beers_deploy.quant.banked.family import Family
from beers_deploy.quant.banked.train import TrainableBody, family_batches, train_body
from beers_deploy.quant.core import IntCore, shift_faults
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.samples import Remade
from beers_deploy.quant.session import open_session, run
from tests.quant.banked.test_family import SENSORS, network
from tests.quant.banked.test_filters import textured


def quantised(scale: int, steps: int = 0) -> tuple[Family, IntCore]:
    """A small family, trained for so many steps on one batch, and its body."""
    made, bodies = network(scale), list[IntCore]()
    weights = Weights({name: value.numpy() for name, value in made.state_dict().items()}, made.variant, {})
    images = [bank_results(textured(48, 48, k), bank_of_vector(each), each, scale) for k, each in enumerate(SENSORS)]

    def trained(body: IntCore) -> IntCore:
        bodies.append(train_body(body, repeat(batch()), steps) if steps else body)
        return bodies[0]

    middle = bank_of_vector((0.0, 0.0, 0.0, 0.0))
    return quantise_family(weights, middle, Remade(images.__getitem__, len(images)), trained=trained), bodies[0]


def batch() -> tuple[np.ndarray, ...]:
    seen = np.concatenate([textured(48, 48, 10 + k) for k in range(len(SENSORS))])
    return seen, seen + 0.02, np.array(SENSORS, np.float32)


@pytest.mark.parametrize("scale", [1, 2])
def test_what_is_trained_is_what_the_files_of_the_sensors_compute(scale: int) -> None:
    family, body = quantised(scale)
    images, _, vectors = batch()
    trainable = TrainableBody(body).restored(images, vectors).detach().numpy()
    for image, vector, found in zip(images, SENSORS, trainable, strict=True):
        bank = bank_of_vector(vector)
        restored = run(open_session(host_model(family.for_sensor(bank, vector), {})), image[None])
        # The trained copy's last rounding, and that of biases, is not in the loop.
        assert np.sqrt(np.square(restored[0] - found.clip(0, 1)).mean()) < 0.03 * bank.unit


def test_training_lowers_the_error_on_what_it_saw_and_stays_legal() -> None:
    images, reference, vectors = batch()
    errors = []
    for steps in (0, 100):
        family, body = quantised(1, steps)
        assert not shift_faults(family.core)
        errors.append(np.square(TrainableBody(body).restored(images, vectors).detach().numpy() - reference).mean())
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.slow
def test_batches_are_those_of_the_family_against_references_without_noise() -> None:
    one, other = (next(family_batches(draw_scenes(2, 1), seed=3)) for _ in range(2))
    degraded, reference, vectors = one
    assert degraded.shape == reference.shape == (8, 1, 96, 96)
    assert len(np.unique(vectors, axis=0)) > 1
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
