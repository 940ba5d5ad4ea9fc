"""Machines are shared: no property test is judged by its time.

Real images lie beside the repository, or nowhere.

What many tests need and no test changes is made once a process: the tree of commands and the drawn
scenes.
"""

import os
import sys
from functools import cache, lru_cache
from pathlib import Path

# Before any test is imported, and so before torch is: the suite runs in several processes, a core
# each.
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
    """Keep the drawn scenes, where a test's imports reach them: an emulated processor is spared
    Pillow and SciPy.
    """
    if drawing := sys.modules.get("beers_deploy.model.simulator.procedural"):
        drawing.draw_scenes = lru_cache(maxsize=4)(drawing.draw_scenes)  # type: ignore[attr-defined]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real images, `shared/data` beside the repository's root."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no folder shared/data beside the repository: no real images to test on")
    return SHARED_DATA


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one small drawn scene: to draw those that a command takes of itself is most of
    its time.
    """
    import numpy as np
    import tifffile

    from beers_deploy.model.simulator.procedural import procedural_scene

    folder = tmp_path_factory.mktemp("scenes")
    tifffile.imwrite(
        folder / "drawn.tif", procedural_scene(900, 900, np.random.default_rng(77)).radiance
    )
    return folder
