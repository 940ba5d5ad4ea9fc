"""`train`: a network's weights from images and two sensor profiles."""

import logging
import os
from collections.abc import Sequence
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Annotated, Literal

from beers_deploy.profiles.errors import OptionError
from beers_deploy.verbs.parameters import (
    Holds,
    InputPath,
    InputPaths,
    Interval,
    OutputFolder,
    Progress,
    Seed,
    SensorLike,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb

logger = logging.getLogger(__name__)

RANGE = "pleiades-variable"
"""The sensors of a network that is for no single one."""

FILES = ("checkpoint.safetensors", "log.csv", "validation.csv", "validation.png")
"""The files of a run in addition to the weights."""

BESIDE_RECIPE = {"out", "recipe", "images", "device", "resume", "progress"}
"""Parameters that a recipe does not state."""


@verb
def train(
    *,
    out: Annotated[OutputFolder, Holds(*FILES, folders=("",))],
    recipe: InputPath | None = None,
    images: InputPaths = (),
    pairs: InputPath | None = None,
    variant: str = "convbeers-s",
    sensor: SensorLike | None = None,
    conditioned: bool = False,
    reference: SensorLike | None = None,
    drawn: Annotated[int, Interval(ge=0, le=1000)] = 0,
    steps: Annotated[int, Interval(ge=1)] = 20_000,
    batch: Annotated[int, Interval(ge=1, le=4096)] = 8,
    patch: Annotated[int, Interval(ge=17, le=2048)] = 96,
    learning_rate: Annotated[float, Interval(ge=0)] = 1e-3,
    l1_weight: Annotated[float, Interval(ge=0)] = 1.0,
    lpips_weight: Annotated[float, Interval(ge=0)] = 0.5,
    fft_weight: Annotated[float, Interval(ge=0)] = 0.1,
    psnr_weight: Annotated[float, Interval(ge=0)] = 0.0,
    lpips: InputPath | None = None,
    start: InputPath | None = None,
    rounding: InputPath | None = None,
    validate_every: Annotated[int, Interval(ge=0)] = 1000,
    seed: Seed = 0,
    device: str = "cpu",
    precision: Literal["float32", "bfloat16"] = "float32",
    resume: bool = False,
    progress: Progress = None,
) -> Path:
    """Train a network on simulated or stored pairs; the same seed makes the same weights.

    The loss is the paper's: 1.0 L1 + 0.5 LPIPS + 0.1 L1 of spectra. Without weights for LPIPS that
    term is left out, which is logged. A twentieth of the images, whole sites, is held out for
    validation. For several GPUs start it with torchrun.

    Args:
        out: folder of checkpoint, logs, pictures and weights.
        recipe: recipe to run, a shipped name or a .toml file, which states all other options of the
            training.
        images: folder of sharp aerial images (8-bit RGB, or 16-bit mono) to simulate from; repeat
            it for several.
        pairs: folder of pairs that 'simulate' wrote, in place of images.
        variant: size of the network.
        sensor: sensor of the degraded images: name or .toml file; by default the one that made the
            pairs, or pleiades-variable.
        conditioned: train for a wide range of sensors with the gain of `sensor`. The network can
            then be conditioned on any sensor in range.
        reference: sensor of the reference images; pleiades-reference by default.
        drawn: number of drawn scenes to add to the images.
        steps: number of gradient steps.
        batch: number of patches for each step and worker.
        patch: side of a patch in pixels.
        learning_rate: highest learning rate.
        l1_weight: weight of L1 in the loss.
        lpips_weight: weight of LPIPS in the loss.
        fft_weight: weight of the L1 of spectra in the loss.
        psnr_weight: weight of the patches' mean PSNR in the loss, such as 0.01 without L1.
        lpips: weights of SqueezeNet 1.1 for LPIPS-squeeze, or a folder of backbones.
        start: weights to start from; those of a smaller network are widened.
        rounding: INT8 file of the `start` weights: training applies its rounding of feature maps,
            so that a new quantisation loses less.
        validate_every: number of steps between validations; 0 for none.
        seed: seed of every random draw.
        device: device of the training, cpu or cuda.
        precision: number format of the convolutions; bfloat16 is faster on devices with units for
            it.
        resume: continue the run from its checkpoint.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        The path of the weights.

    Raises:
        OptionError: options that do not go together, or a folder that holds a run.
        ImageError: images or pairs that cannot be read.
        ModelError: weights to start from that do not fit.
        ProfileError: no such sensor.
        MissingExtraError: torch is not installed.
    """
    options = partial(changed, train, locals())
    several = [images] if isinstance(images, str | os.PathLike) else images
    folders = tuple(map(Path, several))
    if recipe is not None:
        stated = [name for name in signature(train).parameters if name not in BESIDE_RECIPE]
        refuse_with("`recipe`, which states it", **options(*stated))
        return _make(os.fspath(recipe), folders, Path(out), resume, device)
    if pairs is not None:
        refuse_with("`pairs`", images=bool(folders), **options("drawn", "conditioned"))
    if rounding is not None and not (conditioned and start):
        raise OptionError(
            "`rounding` has no effect without `conditioned` and `start`. Add both, or leave "
            "`rounding` out."
        )
    # 0 requests no validation, which is allowed without images.
    if not folders and validate_every:
        refuse_without("`images`", **options("validate_every"))
    if not lpips_weight:
        refuse_with("`lpips_weight` 0", **options("lpips"))
    # These load torch.
    from beers_deploy.model.family import SensorFamily
    from beers_deploy.model.io.files import require_writable, sha256
    from beers_deploy.model.pairs_recipe import profiles_for, read_pairs_recipe
    from beers_deploy.model.training.checkpoint import TrainingRecipe
    from beers_deploy.model.training.losses import LossWeights
    from beers_deploy.model.training.patches import PatchRecipe
    from beers_deploy.model.training.run import Run
    from beers_deploy.model.training.run import train as run_training
    from beers_deploy.model.training.trainer import joined
    from beers_deploy.network_files import weights_file
    from beers_deploy.quantization import rounding_of

    stored = path_or_none(pairs)
    start_file = None if start is None else weights_file(Path(start))
    rounding_file = None if rounding is None else weights_file(Path(rounding))
    lpips_file = path_or_none(lpips)
    sources = [*folders] if stored is None else [stored, stored / "degraded", stored / "reference"]
    profiles = [Path(each) for each in (sensor, reference) if isinstance(each, str | os.PathLike)]
    inputs = (*sources, lpips_file, start_file, rounding_file, *profiles)
    folder = Path(out)
    require_writable(folder / f"{variant}.safetensors", inputs=inputs)
    # The INT8 file must be of the start weights, or its rounding is another network's.
    rounded = rounding_of(rounding_file, start_file) if rounding_file and start_file else None
    numbers = TrainingRecipe(
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        loss=LossWeights(l1_weight, lpips_weight, fft_weight, psnr_weight),
        seed=seed,
        rounding=sha256(rounding_file) if rounding_file else "",
    )
    pairs_recipe = read_pairs_recipe(stored) if stored else None
    degraded, aim = profiles_for(
        sensor or (None if pairs_recipe else RANGE), reference, pairs_recipe
    )
    family = SensorFamily(degraded.nominal()) if conditioned else None
    run = Run(
        variant,
        numbers,
        PatchRecipe(degraded, aim, patch_px=patch, family=family),
        folders,
        stored,
        folder,
        drawn=drawn,
        lpips=lpips_file,
        start=start_file,
        validate_steps=validate_every,
        device=device,
        precision=precision,
        rounding=rounded,
    )
    # Under torchrun every worker runs this, and the first one alone reports.
    with joined(device) as worker:
        run_training(run, resume, worker)
        if worker.first:
            logger.info("wrote %s", run.weights)
    return run.weights


def _make(name: str, images: Sequence[Path], out: Path, resume: bool, device: str) -> Path:
    """Make a network from its recipe, and return its weights."""
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.shipped import INT8
    from beers_deploy.model.training.recipe import load_recipe, recipe_file
    from beers_deploy.studies.recipes import make_network

    recipe = load_recipe(name)
    if not images:
        raise OptionError(
            "`recipe` needs `images`. Give the folders of the photographs that the model card "
            "names."
        )
    path = recipe_file(name)
    outputs = [out / f"{path.stem}{end}" for end in (".safetensors", f"{INT8}.onnx", ".md")]
    require_writable(*outputs, inputs=images)
    make_network(path, recipe, images, out, resume, device)
    return outputs[0]
