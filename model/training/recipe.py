"""Read a recipe: a TOML file with everything that is needed to reproduce a shipped network.

`model/recipes/NAME.toml` is the recipe of each shipped network. `beers-deploy train --recipe NAME`
runs it.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import Field, StrictBool, with_config

from beers_deploy.model.processor import SEEDS
from beers_deploy.model.training.looks import Looks
from beers_deploy.model.training.losses import LossWeights
from beers_deploy.model.training.trainer import Precision
from beers_deploy.model.variants import variant_named
from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.toml import read_toml_text
from beers_deploy.profiles.validation import CONFIG, Amount, Share, validated

RECIPES = Path(__file__).parents[1] / "recipes"

FolderName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
"""A name that leads to no other folder."""


@with_config(CONFIG)
@dataclass(frozen=True)
class Stage:
    """A part of a training with one learning rate schedule.

    Attributes:
        name: the name of its folder.
        steps: the number of gradient steps.
        batch: the number of patches of a step.
        learning_rate: the highest learning rate, which falls to 0 as a cosine.
        rounding: True to round maps as the INT8 file of the initial weights of the stage does.
        precision: the precision of the blocks, float32 or bfloat16.
        average: decay per step of the running average of the weights, which is stored.
    """

    name: FolderName
    steps: Annotated[int, Field(strict=True, ge=1)]
    batch: Annotated[int, Field(strict=True, ge=1, le=4096)] = 8
    learning_rate: Amount = 1e-3
    rounding: StrictBool = False
    precision: Precision = "bfloat16"
    average: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.999


@with_config(CONFIG)
@dataclass(frozen=True)
class NetworkRecipe:
    """The complete parameters of a network's training.

    Attributes:
        variant: the name of the network's size.
        stages: the stages in order; each begins with the weights of the one before.
        start: the name of a shipped network; the first stage begins with its weights, enlarged to
            the size of `variant`. "" draws random weights.
        seed: the seed of weights, charts and patches; each stage adds its number.
        patch_px: the side of a patch in pixels.
        charts: the number of drawn charts in addition to the images.
        held_out: sites that are not trained on, and by which a network is selected.
        other_curves: the share of sensors whose MTF has another curve than exp(-gamma f) sinc f.
        looks: how light, contrast and softness of the ground are drawn.
        loss: the weight of each term of the loss.
        attribution: a line for each source of images, for the model card.
        notes: sentences for the model card.
    """

    variant: str
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)]
    start: str = ""
    seed: Annotated[int, Field(strict=True, ge=0, le=SEEDS)] = 0
    patch_px: Annotated[int, Field(strict=True, ge=17, le=2048)] = 96
    charts: Annotated[int, Field(strict=True, ge=0, le=1000)] = 0
    held_out: tuple[str, ...] = ()
    other_curves: Share = 0.0
    looks: Looks = field(default_factory=Looks)
    loss: LossWeights = field(default_factory=LossWeights)
    attribution: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def recipe_names() -> list[str]:
    """List the names of the shipped recipes."""
    return sorted(path.stem for path in RECIPES.glob("*.toml"))


def recipe_file(name: str) -> Path:
    """Return the path of a recipe: a shipped name, or the path of a .toml file.

    Raises ProfileError if there is no such recipe.
    """
    if name.endswith(".toml"):
        return Path(name)
    if name not in recipe_names():
        raise ProfileError(
            f"There is no recipe {name!r}. Choose one of {', '.join(recipe_names())}, or give the "
            "path of a .toml file."
        )
    return RECIPES / f"{name}.toml"


def load_recipe(name: str) -> NetworkRecipe:
    """Read a recipe.

    Args:
        name: the name of a shipped recipe, or the path of a .toml file.

    Raises:
        ProfileError: no such recipe, a key that is unknown or missing, or a value that no training
            can have.
    """
    path = recipe_file(name)
    try:
        raw = read_toml_text(path)
    except (OSError, ValueError) as error:
        raise ProfileError(
            f"The recipe {path} cannot be read: {printable(str(error))}. Correct the file or its "
            "path."
        ) from error
    where = f"recipe {path.name}"
    recipe = validated(NetworkRecipe, raw, where)
    variant_named(recipe.variant)
    if recipe.stages[0].rounding and not recipe.start:
        raise ProfileError(
            f"The {where} begins with a stage with rounding, which needs the INT8 file of trained "
            "weights, but there are none yet. Put a stage without rounding in front."
        )
    return recipe
