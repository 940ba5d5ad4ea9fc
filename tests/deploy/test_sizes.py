"""Sizes are width x height wherever one is printed: here of 61 columns and 37 rows."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from typer.testing import CliRunner

from beers_deploy.cli import app
from beers_deploy.export import float_for
from beers_deploy.model.shipped import SENSOR, VARIANT, shipped_weights
from beers_deploy.model.simulator.acquire import crop_margin
from beers_deploy.model.training.patches import StoredPairs, pair_files
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import BeersError
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.plan import plan_for

ROWS, COLUMNS = 37, 61
IMAGE = np.random.default_rng(0).integers(200, 1800, (ROWS, COLUMNS)).astype(np.uint16)


def plan_of_restore(folder: Path) -> str:
    tifffile.imwrite(folder / "raw.tif", IMAGE)
    command = ["restore", str(folder / "raw.tif"), str(folder / "out.tif"), "--network", "convbeers-xs"]
    return CliRunner().invoke(app, command).output


def fixed_tile(_: Path) -> str:
    model = float_for(shipped_weights(VARIANT), VARIANT, load_sensor(SENSOR), 64)
    return said(lambda: plan_for(model, (1, ROWS, COLUMNS), Options(Path(), 64)))


def stored_pairs(folder: Path) -> str:
    for role in ("degraded", "reference"):
        (folder / role).mkdir()
        Image.fromarray(IMAGE).save(folder / role / "a.png")
    return said(lambda: next(StoredPairs(pair_files(folder), 40, 4095, 1, 0).batches()))


def said(work: Callable[[], object]) -> str:
    with pytest.raises(BeersError) as caught:
        work()
    return str(caught.value)


SENTENCES: list[Callable[[Path], str]] = [
    plan_of_restore,
    fixed_tile,
    stored_pairs,
    lambda _: said(lambda: crop_margin(torch.zeros(ROWS, COLUMNS), 30)),
]


@pytest.mark.parametrize("sentence", SENTENCES)
def test_a_sentence_names_the_width_first(sentence: Callable[[Path], str], tmp_path: Path) -> None:
    text = sentence(tmp_path)
    assert f"{COLUMNS} x {ROWS}" in text
    assert f"{ROWS} x {COLUMNS}" not in text
