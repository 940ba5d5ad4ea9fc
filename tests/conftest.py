"""Machines are shared: no property test is judged by its time. Real images lie beside the repository, or nowhere."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# Before any test is imported: what is made for a sensor goes into no user's cache.
os.environ["BEERS_DEPLOY_CACHE"] = tempfile.mkdtemp(prefix="beers-deploy-tests-")
atexit.register(shutil.rmtree, os.environ["BEERS_DEPLOY_CACHE"], ignore_errors=True)

settings.register_profile("project", deadline=None)
settings.load_profile("project")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real images, `shared/data` beside the repository's root."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no folder shared/data beside the repository: no real images to test on")
    return SHARED_DATA
