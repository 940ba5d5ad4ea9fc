"""Make a shipped network from its recipe: stage after stage, its INT8 file, and its model card.

OUT/1-float/      checkpoint, logs, pictures and weights of the first stage
OUT/2-rounded/    of the second; start-int8.onnx is the INT8 file whose roundings it trains with
OUT/NAME.safetensors  OUT/NAME-int8.onnx  OUT/NAME.md
"""

import hashlib
import logging
import math
import shutil
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import torch

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.io.files import sha256, write_text
from beers_deploy.model.processor import processor_name
from beers_deploy.model.raster.images import list_images, site_of
from beers_deploy.model.shipped import INT8, SENSOR, shipped_weights
from beers_deploy.model.training.checkpoint import TrainingRecipe
from beers_deploy.model.training.patches import PatchRecipe
from beers_deploy.model.training.recipe import RECIPES, NetworkRecipe, Stage
from beers_deploy.model.training.run import Run, train
from beers_deploy.model.training.trainer import Worker
from beers_deploy.model.variants import VARIANTS, Variant
from beers_deploy.network_files import Conditioned
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.quantization import family_model, rounding_of

logger = logging.getLogger(__name__)


def make_network(
    path: Path,
    recipe: NetworkRecipe,
    images: Sequence[Path],
    out: Path,
    resume: bool,
    device: str,
) -> None:
    """Train a network by its recipe, and write its weights, its INT8 file and its model card.

    Args:
        path: the recipe's file, whose stem is the name of the network.
        recipe: all parameters of the training, in one or several stages.
        images: folders of photographs to train on.
        out: the output folder, with a folder for each stage.
        resume: True to continue the run in the folder; otherwise it must contain no run.
        device: the device of torch, 'cpu' or 'cuda'.

    Raises:
        OptionError: the folder contains a run, or one that cannot be continued with this recipe.
        ModelError: the training diverges, or weights do not fit the recipe.
    """
    name = path.stem
    toml = path.read_text(encoding="utf-8")
    label = name if path.parent == RECIPES else path.name
    weights = shipped_weights(recipe.start) if recipe.start else None
    for number, stage in enumerate(recipe.stages, 1):
        run = stage_run(recipe, number, stage, images, out, weights, device)
        # A later stage may not have begun, but without a first one there is nothing to continue.
        goes_on = resume and (number == 1 or run.checkpoint.exists())
        train(run, goes_on, Worker())
        weights = run.weights
        logger.info("stage %d of %d, %s: wrote %s", number, len(recipe.stages), stage.name, weights)
    assert weights is not None  # noqa: S101 - a recipe has a stage
    finished = out / f"{name}.safetensors"
    shutil.copyfile(weights, finished)
    int8 = out / f"{name}{INT8}.onnx"
    save_onnx(family_model(Conditioned(name, finished), images), int8)
    card = out / f"{name}.md"
    write_text(card, model_card(label, recipe, toml, images))
    for file in (finished, int8, card):
        logger.info("wrote %s", file)


def stage_run(
    recipe: NetworkRecipe,
    number: int,
    stage: Stage,
    images: Sequence[Path],
    out: Path,
    start: Path | None,
    device: str,
) -> Run:
    """Return the options of the training run of one stage of a recipe.

    If the stage trains with the rounding of INT8, this also writes the INT8 file of the weights
    that the stage begins with, unless it exists.

    Args:
        recipe: the recipe of the network.
        number: the number of the stage, from 1.
        stage: the stage.
        images: folders of photographs.
        out: the output folder of the recipe, in which the stage gets the folder NUMBER-NAME.
        start: the weights that the stage begins with; None draws them.
        device: the device of torch, 'cpu' or 'cuda'.
    """
    folder = out / f"{number}-{stage.name}"
    rounding = None
    digest = ""
    if stage.rounding and start is not None:
        int8 = folder / "start-int8.onnx"
        if not int8.exists():
            save_onnx(family_model(Conditioned(recipe.variant, start), images), int8)
        rounding = rounding_of(int8, start)
        digest = sha256(int8)
    degraded = Sensor.load(SENSOR)
    reference = Sensor.load(REFERENCE)
    family = SensorFamily(degraded.nominal(), other_curves=recipe.other_curves)
    patches = PatchRecipe(
        degraded,
        reference,
        patch_px=recipe.patch_px,
        looks=recipe.looks,
        family=family,
        noisy_reference=False,
    )
    numbers = TrainingRecipe(
        steps=stage.steps,
        batch=stage.batch,
        learning_rate=stage.learning_rate,
        ema_decay=stage.average,
        loss=recipe.loss,
        seed=recipe.seed + number - 1,
        rounding=digest,
    )
    return Run(
        recipe.variant,
        numbers,
        patches,
        tuple(images),
        None,
        folder,
        charts=recipe.charts,
        held_out=recipe.held_out,
        start=start,
        device=device,
        precision=stage.precision,
        rounding=rounding,
    )


def model_card(label: str, recipe: NetworkRecipe, toml: str, images: Sequence[Path]) -> str:
    """Return the Markdown text of the model card of a trained network, which states its recipe, its
    data, and the machine that trained it.

    Args:
        label: the recipe's name if it is shipped, or the name of its file.
        recipe: the recipe of the network.
        toml: the text of the recipe's file, which the card quotes.
        images: folders of the photographs that it was trained on; their names and content enter a
            digest.
    """
    variant = VARIANTS[recipe.variant]
    files = list(chain.from_iterable(map(list_images, images)))
    # Sorted by name, so that the digest does not depend on the order of the folders.
    by_name = sorted(files, key=lambda file: file.name)
    digests = "".join(f"{file.name} {sha256(file)}\n" for file in by_name)
    photos = [file for file in files if site_of(file.name) not in recipe.held_out]
    data = hashlib.sha256(digests.encode()).hexdigest()
    attribution = "".join(f"- {line}\n" for line in recipe.attribution)
    notes = "".join(f"{line}\n\n" for line in recipe.notes)
    patches = sum(stage.steps * stage.batch for stage in recipe.stages)
    name = label.removesuffix(".toml")
    folders = " ".join(f"--images {folder.resolve().name}/" for folder in images)
    return f"""# {name}

{described(variant)} behind the bank of its sensor: one set of weights and one INT8 file for \
every sensor in range.

**Made by**

    beers-deploy train --recipe {label} {folders} --out runs/{name}

on {processor_name()} with PyTorch {torch.__version__}: {patches} patches of {len(photos)} \
photographs, whose list of names and digests has the SHA-256 `{data[:16]}`, and {recipe.charts} \
drawn charts. Sites that are held out choose; {len(files) - len(photos)} photographs show them. \
The recipe:

```toml
{toml.strip()}
```

{notes}**Data**

{attribution}"""


def described(variant: Variant) -> str:
    """Describe the size of a network in words for its model card: blocks, features, resolution and
    number of parameters.
    """
    parameters = sum(math.prod(shape) for shape in variant.banked_shapes.values())
    at = f" at 1/{variant.scale} of the resolution" if variant.scale > 1 else ""
    return (
        f"{variant.blocks} residual blocks of {variant.features} features{at}, "
        f"{parameters / 1000:.0f} k parameters,"
    )
