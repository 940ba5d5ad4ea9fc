"""Tests that a folder of pairs holds its recipe: the sensors, the sites and the profiles."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from beers_deploy.model.dataset import DatasetRecipe, write_dataset
from beers_deploy.model.pairs_recipe import profiles_for, read_pairs_recipe
from beers_deploy.profiles.errors import OptionError, ProfileError
from beers_deploy.profiles.sensor import Sensor, same_instrument
from beers_deploy.profiles.shipped import sensor_names
from beers_deploy.profiles.validation import validated
from beers_deploy.studies.evaluation.pairs import oversamplings_of, read_pairs

SEVERE = Sensor.load("dior-high")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write pairs of a non-default sensor: two frames of one site and one of another."""
    here = tmp_path_factory.mktemp("pairs")
    scenes = list[Path]()
    for name in ("forest_1.png", "forest_2.png", "port_1.png"):
        pixels = np.random.default_rng(len(scenes)).integers(0, 255, (170, 192), np.uint8)
        Image.fromarray(pixels).save(here / name)
        scenes.append(here / name)
    recipe = DatasetRecipe(tuple(scenes), SEVERE, SEVERE.reference, oversampling=2, patch_px=15)
    write_dataset(recipe, here / "out", 1, False)
    return here / "out"


def test_the_sensor_that_made_the_pairs_is_known(folder: Path) -> None:
    degraded, reference = profiles_for(None, None, read_pairs_recipe(folder))
    assert same_instrument(degraded, SEVERE)
    assert (degraded.name, reference.name) == ("dior-high", "pleiades-reference")


def test_a_sensor_that_contradicts_the_recipe_is_refused(folder: Path) -> None:
    recipe = read_pairs_recipe(folder)
    assert profiles_for("dior-high", "pleiades-reference", recipe)[0].name == "dior-high"
    with pytest.raises(
        OptionError,
        match=r"`sensor` must be the sensor that made the pairs, dior-high.* is pleiades-degraded",
    ):
        profiles_for("pleiades-degraded", None, recipe)
    with pytest.raises(OptionError, match="`reference` must"):
        profiles_for(None, "dior-medium", recipe)


def test_frames_and_patches_of_a_site_are_one_site(folder: Path) -> None:
    pairs = read_pairs(folder, recipe=read_pairs_recipe(folder))
    assert len(pairs) > 3
    assert {pair.site for pair in pairs} == {"forest", "port"}


def test_without_a_recipe_the_sensor_is_the_one_named(tmp_path: Path) -> None:
    assert read_pairs_recipe(tmp_path) is None
    assert profiles_for("dior-high", None, None)[0] == SEVERE
    assert profiles_for(None, None, None)[0].name == "pleiades-degraded"


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"scenes": 3}', '{"scenes": [{}], "degraded": 1}']
)
def test_a_recipe_of_another_kind_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "recipe.json").write_text(text)
    with pytest.raises((OptionError, ProfileError), match=r"recipe\.json"):
        read_pairs_recipe(tmp_path)


@pytest.mark.parametrize("name", sensor_names())
def test_a_profile_is_read_back_from_json(name: str) -> None:
    profile = Sensor.load(name)
    assert validated(Sensor, json.loads(json.dumps(asdict(profile))), "a test") == profile


def test_the_profiles_oversampling_is_kept_up_to_four() -> None:
    assert oversamplings_of(Sensor.load("pleiades-degraded")) == (4, 2)
    assert oversamplings_of(SEVERE) == (3, 2)


def test_images_of_fourteen_bits_are_read_as_such(tmp_path: Path) -> None:
    for role in ("degraded", "reference"):
        (tmp_path / role).mkdir()
        tifffile.imwrite(tmp_path / role / "a.tif", np.full((49, 51), 9000, np.uint16))
    assert read_pairs(tmp_path, 16383)[0].degraded.max() == 9000
