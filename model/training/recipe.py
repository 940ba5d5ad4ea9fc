"""Read a recipe: a TOML file with everything that is needed to reproduce a shipped network.

`model/recipes/NAME.toml` is the recipe of each shipped network. `beers-deploy train --recipe NAME`
runs it.
"""

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

from beers_deploy.model.training.looks import Looks
from beers_deploy.model.training.losses import LossWeights
from beers_deploy.model.training.trainer import Precision
from beers_deploy.model.variants import variant_named
from beers_deploy.profiles.constant import is_number
from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.toml import read_toml_text
from beers_deploy.profiles.validation import check_keys

RECIPES = Path(__file__).parents[1] / "recipes"

T = TypeVar("T")


def _whole(value: Any) -> bool:
    # Python counts True as an int.
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _number(value: Any) -> bool:
    return is_number(value) and value >= 0


def _list_of(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(map(fits, value))


KINDS: Mapping[object, tuple[Callable[[Any], bool], str]] = {
    bool: (lambda value: isinstance(value, bool), "true or false"),
    str: (lambda value: isinstance(value, str), "a string"),
    int: (_whole, "an integer of 0 or more"),
    float: (_number, "a number of 0 or more"),
    tuple[float, float]: (
        lambda value: _list_of(value, _number) and len(value) == 2,
        "two numbers of 0 or more",
    ),
    tuple[str, ...]: (
        lambda value: _list_of(value, lambda item: isinstance(item, str)),
        "a list of strings",
    ),
    Precision: (
        lambda value: value in get_args(Precision),
        f"one of {', '.join(get_args(Precision))}",
    ),
}
"""The values that a field of each type accepts: a check, and their description in messages."""


@dataclass(frozen=True)
class Stage:
    """A part of a training with one learning rate schedule.

    Attributes:
        name: of its folder.
        steps: the number of gradient steps.
        batch: patches per step.
        learning_rate: the highest; a cosine leads it down to 0.
        rounding: whether maps are rounded as in the INT8 file of the weights that the stage begins
            with.
        precision: of the blocks, float32 or bfloat16.
        average: decay per step of the running average of the weights, which is stored.
    """

    name: str
    steps: int
    batch: int = 8
    learning_rate: float = 1e-3
    rounding: bool = False
    precision: Precision = "bfloat16"
    average: float = 0.999


@dataclass(frozen=True)
class NetworkRecipe:
    """The complete parameters of a network's training.

    Attributes:
        variant: its size.
        stages: in order; each begins with the weights of the one before.
        start: shipped network whose weights, grown, the first stage begins with; "" draws weights.
        seed: of weights, charts and patches; each stage adds its number.
        patch_px: side of a patch.
        charts: the number of drawn charts in addition to the images.
        held_out: sites that are not trained on, and by which a network is selected.
        other_curves: share of sensors with an MTF of another curve than the formula's.
        looks: of the ground.
        loss: weights of its terms.
        attribution: of the images.
        notes: sentences for the model card.
    """

    variant: str
    stages: tuple[Stage, ...]
    start: str = ""
    seed: int = 0
    patch_px: int = 96
    charts: int = 0
    held_out: tuple[str, ...] = ()
    other_curves: float = 0.0
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
        name: a shipped recipe's, or the path of a .toml file.

    Raises:
        ProfileError: no such recipe, a key that is unknown or missing, or a value that no training
            can have.
    """
    path = recipe_file(name)
    try:
        raw = read_toml_text(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ProfileError(
            f"The recipe {path} cannot be read: {reason}. Check the path."
        ) from error
    except ValueError as error:
        raise ProfileError(
            f"The recipe {path} is not valid TOML: {printable(str(error))}. Correct that line."
        ) from error
    where = f"recipe {path.name}"
    tables = raw.get("stages")
    if not isinstance(tables, list) or not tables:
        raise ProfileError(
            f"The {where} has no stages. Add each stage of the training as a table [[stages]]."
        )
    stages = tuple(
        _build(Stage, f"{where}: stage {number}", table) for number, table in enumerate(tables, 1)
    )
    parts: dict[str, Any] = {"stages": stages}
    for key, kind in (("looks", Looks), ("loss", LossWeights)):
        if key in raw:
            parts[key] = _build(kind, f"{where}: {key}", raw[key])
    recipe = _build(NetworkRecipe, where, {**raw, **parts})
    variant_named(recipe.variant)
    if stages[0].rounding and not recipe.start:
        raise ProfileError(
            f"The {where} begins with a stage with rounding, which needs the INT8 file of trained "
            "weights, but there are none yet. Put a stage without rounding in front."
        )
    return recipe


def _build(kind: type[T], where: str, raw: object) -> T:
    """Build a dataclass from a table, with each value checked against the type of its field."""
    if not isinstance(raw, Mapping):
        raise ProfileError(f"{where} must be a table, got {printable(repr(raw))}.")
    fields_by_name = {field_.name: field_ for field_ in fields(kind)}  # type: ignore[arg-type]
    required = {
        n
        for n, field_ in fields_by_name.items()
        if field_.default is MISSING and field_.default_factory is MISSING
    }
    check_keys(where, raw, required, set(fields_by_name) - required)
    return kind(
        **{
            key: _value(f"{where}: {key}", fields_by_name[key].type, value)
            for key, value in raw.items()
        }
    )


def _value(where: str, kind: object, value: object) -> object:
    """Return a value of a file as its field stores it, or raise ProfileError.

    A value of another type than those in KINDS, such as a nested dataclass, is returned unchanged.
    """
    if kind not in KINDS:
        return value
    fits, expected = KINDS[kind]
    if not fits(value):
        raise ProfileError(f"{where} must be {expected}, got {printable(repr(value))}.")
    return tuple(value) if isinstance(value, list) else value
