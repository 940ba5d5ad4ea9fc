"""`beers-deploy train`: make a network's weights from images and two sensor profiles."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import Lpips, Reference, Seed, refuse, say
from beers_deploy.profiles.errors import OptionError

RANGE = "pleiades-variable"
"""The sensors of a network that is for no single one."""


class Precision(StrEnum):
    """The number format of a step's convolutions."""

    float32 = "float32"
    bfloat16 = "bfloat16"


def train(
    context: typer.Context,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder of checkpoint, logs, pictures and weights.")
    ],
    recipe: Annotated[
        str | None,
        typer.Option(
            help="Make a shipped network: its name, or a recipe of your own (.toml), which says "
            "all else."
        ),
    ] = None,
    images: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of sharp aerial images (8-bit RGB, or 16-bit mono) to simulate from; "
            "several if repeated."
        ),
    ] = None,
    pairs: Annotated[
        Path | None, typer.Option(help="Folder of pairs that 'simulate' wrote, instead.")
    ] = None,
    variant: Annotated[str, typer.Option(help="Size of the network.")] = "convbeers-s",
    sensor: Annotated[
        str | None,
        typer.Option(
            help=f"Profile of the degraded input; of pairs their recipe's, else {RANGE} if none."
        ),
    ] = None,
    conditioned: Annotated[
        bool,
        typer.Option(
            "--conditioned",
            help="Draw sensors of a wide range with that gain, and condition on each.",
        ),
    ] = False,
    reference: Reference = None,
    drawn: Annotated[
        int, typer.Option(min=0, max=1000, help="Drawn scenes to add to the images.")
    ] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Gradient steps.")] = 20_000,
    batch: Annotated[int, typer.Option(min=1, max=4096, help="Patches a step and worker.")] = 8,
    patch: Annotated[int, typer.Option(min=17, max=2048, help="Patch side in pixels.")] = 96,
    learning_rate: Annotated[float, typer.Option(min=0, help="Highest learning rate.")] = 1e-3,
    l1_weight: Annotated[float, typer.Option(min=0, help="Weight of L1 in the loss.")] = 1.0,
    lpips_weight: Annotated[float, typer.Option(min=0, help="Weight of LPIPS in the loss.")] = 0.5,
    fft_weight: Annotated[
        float, typer.Option(min=0, help="Weight of the L1 of spectra in the loss.")
    ] = 0.1,
    psnr_weight: Annotated[
        float,
        typer.Option(min=0, help="Weight of the patches' mean PSNR in the loss; 0.01 without L1."),
    ] = 0.0,
    lpips: Lpips = None,
    start: Annotated[
        Path | None, typer.Option(help="Weights to go on from; those of a smaller network grow.")
    ] = None,
    rounding: Annotated[
        Path | None,
        typer.Option(
            help="INT8 file of the --start weights: trains with the maps rounded as there."
        ),
    ] = None,
    validate_every: Annotated[
        int, typer.Option(min=0, help="Steps between validations; 0 for none.")
    ] = 1000,
    seed: Seed = 0,
    device: Annotated[str, typer.Option(help="cpu, or cuda.")] = "cpu",
    precision: Annotated[
        Precision,
        typer.Option(
            help="Of the body's convolutions; bfloat16 is faster where there are units for it."
        ),
    ] = Precision.float32,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the run's checkpoint.")
    ] = False,
) -> None:
    """Train a network on simulated or stored pairs; resumable, the same weights for the same seed.

    The loss is the paper's: 1.0 L1 + 0.5 LPIPS + 0.1 L1 of spectra; without weights for LPIPS that
    term is left out, which is said and kept in the recipe. A twentieth of the images, whole sites,
    is held out for validation. Several GPUs: start it with torchrun. --conditioned weights become
    the network of any sensor in range; --start then takes such weights, and plain ones without.
    --rounding prepares such weights for INT8: quantised anew they lose less. --recipe runs all
    stages of a shipped network, or of your own recipe, to weights, INT8 file and model card.
    """
    from beers_deploy.model.dataset import profiles_for, read_pairs_recipe
    from beers_deploy.model.family import SensorFamily
    from beers_deploy.model.io.files import require_writable, sha256
    from beers_deploy.model.training.checkpoint import TrainingRecipe
    from beers_deploy.model.training.losses import LossWeights
    from beers_deploy.model.training.patches import PatchRecipe
    from beers_deploy.model.training.run import FILES, Run
    from beers_deploy.model.training.run import train as run_training
    from beers_deploy.model.training.trainer import joined
    from beers_deploy.network_files import weights_file
    from beers_deploy.quantise import rounding_of

    folders = tuple(images or ())
    if recipe is not None:
        _refuse_beside_recipe(context)
        _make(recipe, folders, out, resume, device)
        return
    if pairs is not None and (images is not None or drawn):
        expected = "neither --images nor --drawn beside it"
        remedy = "leave one out"
        raise OptionError("--pairs", expected=expected, got="both", remedy=remedy)
    if conditioned and pairs is not None:
        remedy = "leave one out: stored pairs do not say what sensor each had"
        raise OptionError(
            "--conditioned", expected="no --pairs beside it", got="both", remedy=remedy
        )
    if rounding is not None and not (conditioned and start):
        expected = "--conditioned and --start beside it"
        remedy = "give both, or leave it out"
        raise OptionError("--rounding", expected=expected, got="not both", remedy=remedy)
    _refuse_unused(context)
    stored = (
        [pairs, *(pairs / role for role in ("degraded", "reference"))] if pairs else list(folders)
    )
    start = weights_file(start) if start else None
    rounding = weights_file(rounding) if rounding else None
    inputs = (
        *stored,
        lpips,
        start,
        rounding,
        *(Path(name) for name in (sensor, reference) if name),
    )
    require_writable(*(out / name for name in (*FILES, f"{variant}.safetensors")), inputs=inputs)
    # The INT8 file must be of the --start weights, or its rounding is another network's.
    rounded = rounding_of(rounding, start) if rounding and start else None
    numbers = TrainingRecipe(
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        loss=LossWeights(l1_weight, lpips_weight, fft_weight, psnr_weight),
        seed=seed,
        rounding=sha256(rounding) if rounding else "",
    )
    pairs_recipe = read_pairs_recipe(pairs) if pairs else None
    degraded, aim = profiles_for(
        sensor or (None if pairs_recipe else RANGE), reference, pairs_recipe, say
    )
    family = SensorFamily(degraded.nominal()) if conditioned else None
    patches = PatchRecipe(degraded, aim, patch_px=patch, family=family)
    run = Run(
        variant,
        numbers,
        patches,
        folders,
        pairs,
        out,
        drawn=drawn,
        lpips=lpips,
        start=start,
        validate_steps=validate_every,
        device=device,
        precision=precision.value,
        rounding=rounded,
    )
    # Under torchrun every worker runs this, and the first one alone reports.
    with joined(device) as worker:
        run_training(run, resume, worker, say)
        if worker.first:
            say(f"wrote {run.weights}")


BESIDE_RECIPE = ("recipe", "images", "out", "resume", "device")
"""Options that a recipe leaves open."""


def _refuse_beside_recipe(context: typer.Context) -> None:
    """Refuse options that the recipe states."""
    names = [name for name in context.params if name not in BESIDE_RECIPE]
    expected = "no --recipe beside it, which states it"
    remedy = "leave it out, or give a recipe of your own"
    refuse(context, names, expected=expected, got="both", remedy=remedy)


def _make(name: str, images: tuple[Path, ...], out: Path, resume: bool, device: str) -> None:
    """Make a network from its recipe."""
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.shipped import INT8
    from beers_deploy.model.training.recipe import load_recipe, recipe_file
    from beers_deploy.studies.recipes import make_network

    recipe = load_recipe(name)
    if not images:
        remedy = "give the folders of the photographs that the model card names"
        raise OptionError("--recipe", expected="--images beside it", got="none", remedy=remedy)
    outputs = [out / f"{recipe.variant}{end}" for end in (".safetensors", f"{INT8}.onnx", ".md")]
    require_writable(*outputs, inputs=images)
    toml = recipe_file(name).read_text(encoding="utf-8")
    make_network(recipe, toml, images, out, resume, device, say)


def _refuse_unused(context: typer.Context) -> None:
    """Refuse options that would do nothing beside the others."""
    remedy = "leave it out, or give what it needs"
    if not context.params["images"]:
        expected = "--images, of which whole sites are held out, beside it"
        refuse(
            context,
            ["validate_every"],
            expected=expected,
            got="no images: nothing to validate on",
            remedy=remedy,
        )
    if not context.params["lpips_weight"]:
        expected = "a weight of LPIPS in the loss"
        got = "--lpips-weight 0"
        refuse(context, ["lpips"], expected=expected, got=got, remedy="leave one of the two out")
