import numpy as np
import pytest

from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene


@pytest.fixture(scope="session")
def scenes() -> list[Scene]:
    """Return a drawn scene for training."""
    return [procedural_scene(720, 720, np.random.default_rng(0))]
