"""The image that tests restore unless their file has another one. No test changes it."""

from pathlib import Path

import pytest

from tests.deploy.restoration.runs import two_bands


@pytest.fixture(scope="session")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a georeferenced image of two bands."""
    path = tmp_path_factory.mktemp("image") / "raw.tif"
    two_bands(path)
    return path
