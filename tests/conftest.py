"""Settings and fixtures of all tests.

No property test has a deadline, because machines are shared. The tree of commands and the drawn
scenes are built once a process, because many tests need them and no test changes them.
"""

import os
import sys
from functools import cache, lru_cache
from pathlib import Path

# The suite runs in several processes, one core each. This must be set before a test imports torch.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import typer.main
import typer.testing
from hypothesis import settings

settings.register_profile("project", deadline=None)
settings.load_profile("project")

typer.main.get_command = typer.testing._get_command = cache(typer.main.get_command)  # type: ignore[attr-defined]

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def scenes_drawn_once() -> None:
    """Cache the drawn scenes if a test imports their module.

    It is not imported here, so that tests on an emulated processor need no Pillow and SciPy.
    """
    if drawing := sys.modules.get("beers_deploy.model.simulator.procedural"):
        drawing.draw_scenes = lru_cache(maxsize=4)(drawing.draw_scenes)  # type: ignore[attr-defined]


@pytest.fixture
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a temporary folder the working folder, and return it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real images, `shared/data` next to the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no real images: there is no folder shared/data next to the repository")
    return SHARED_DATA


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one small drawn scene.

    A command without it draws its own scenes, which takes most of its time.
    """
    import numpy as np
    import tifffile

    from beers_deploy.model.simulator.procedural import procedural_scene

    folder = tmp_path_factory.mktemp("scenes")
    tifffile.imwrite(
        folder / "drawn.tif", procedural_scene(900, 900, np.random.default_rng(77)).radiance
    )
    return folder
