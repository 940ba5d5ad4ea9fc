"""Tests that the shipped recipes load, and that a wrong recipe gets one sentence."""

from pathlib import Path

import pytest

from beers_deploy.model.io.tensors import read_conditioned
from beers_deploy.model.shipped import shipped_names, shipped_weights
from beers_deploy.model.training.recipe import RECIPES, load_recipe, recipe_names
from beers_deploy.model.variants import VARIANTS
from beers_deploy.profiles.errors import BeersError

STAGE = '[[stages]]\nname = "float"\nsteps = 5\n'
WHOLE = f'variant = "convbeers-xs"\n{STAGE}'


@pytest.mark.parametrize("name", recipe_names())
def test_a_shipped_recipe_fits_the_network_of_its_name(name: str) -> None:
    recipe = load_recipe(name)
    variant = VARIANTS[recipe.variant]
    assert read_conditioned(shipped_weights(name)).variant == variant
    # The consistency step reads whole blocks of 8 pixels at the network's resolution.
    assert recipe.patch_px % (8 * variant.scale) == 0
    assert recipe.stages[-1].rounding
    assert recipe.start in ("", *shipped_names())
    assert recipe.held_out


def test_every_recipe_is_of_a_shipped_network() -> None:
    assert set(recipe_names()) <= set(shipped_names())
    assert all(path.suffix == ".toml" for path in RECIPES.iterdir() if path.name != "__pycache__")


def test_a_key_that_a_recipe_leaves_out_has_its_default(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(WHOLE)
    recipe = load_recipe(str(tmp_path / "own.toml"))
    assert (recipe.seed, recipe.patch_px, recipe.stages[0].batch, recipe.looks.lit_share) == (
        0,
        96,
        8,
        0.0,
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (STAGE, "recipe own.toml has no key 'variant'"),
        ('variant = "convbeers-xs"\n', "recipe own.toml has no key 'stages'"),
        (WHOLE.replace("convbeers-xs", "huge"), "'huge'"),
        (WHOLE + "[looks]\nlit_shar = 0.4\n", "looks has the unknown key 'lit_shar'"),
        (WHOLE + "[loss]\npsnr = -1.0\n", "loss.psnr must be greater than or equal to 0, got -1"),
        (WHOLE.replace("= 5", "= true"), "stages.0.steps must be a valid integer, got True"),
        (WHOLE + 'precision = "int8"\n', "must be 'float32' or 'bfloat16', got 'int8'"),
        (WHOLE + "steps_more = 5\n", "stages.0 has the unknown key"),
        (WHOLE + "rounding = true\n", "Put a stage without rounding in front"),
        ("held_out = [3]\n" + WHOLE, "held_out.0 must be a text, got 3"),
        (WHOLE.replace("float", "../a"), "stages.0.name must be a name of letters"),
        (WHOLE.replace("= 5", "= 0"), "steps must be greater than or equal to 1, got 0"),
        (WHOLE + "batch = 0\n", "batch must be greater than or equal to 1, got 0"),
        (WHOLE + "average = 1.0\n", "average must be less than 1, got 1.0"),
        ("patch_px = 1\n" + WHOLE, "patch_px must be greater than or equal to 17, got 1"),
        (f"seed = {1 << 63}\n" + WHOLE, "seed must be less than or equal to"),
        ("other_curves = 2.0\n" + WHOLE, "other_curves must be less than or equal to 1"),
        (WHOLE + "[looks]\nlights = [0.0, 1.0]\n", "lights.0 must be greater than 0"),
        (WHOLE + "[looks]\nexposures = [2.0, 1.0]\n", "must have its lower end first"),
        ('variant = "convbeers-xs"\nstages = []\n', "stages must be a list that is not empty"),
        ("variant = [", "line 1, 'variant = ['"),
    ],
)
def test_a_wrong_recipe_gets_one_sentence(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(BeersError) as error:
        load_recipe(str(path))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["none.toml", "convbeers-huge"])
def test_a_missing_recipe_is_named(name: str) -> None:
    with pytest.raises(BeersError, match=name):
        load_recipe(name)
