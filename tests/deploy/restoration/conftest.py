"""The image that tests restore unless their file has another one, and a run without its checks."""

from pathlib import Path

import pytest

from beers_deploy.restoration.sensor_check.check import SensorCheck
from tests.deploy.restoration.runs import two_bands


@pytest.fixture(scope="session")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a georeferenced image of two bands. No test changes it."""
    path = tmp_path_factory.mktemp("image") / "raw.tif"
    two_bands(path)
    return path


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the comparison of the image with its sensor and the search for faulty detectors.

    They take half of the time of a small run, and change no pixel.
    """
    prepare = "beers_deploy.restoration.prepare"
    monkeypatch.setattr(f"{prepare}.warn_of_detectors", lambda *_: None)
    monkeypatch.setattr(f"{prepare}.checked_sensor", lambda *_: SensorCheck())
    monkeypatch.setattr(f"{prepare}.restored_already", lambda *_: "")
