"""Run a training from options to a folder: checkpoint, logs, validation pictures, and weights with
their recipe.

RUN/checkpoint.safetensors  RUN/log.csv  RUN/validation.csv  RUN/validation.png
RUN/VARIANT.safetensors
"""

import csv
import hashlib
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

import torch

from beers_deploy.model.convbeers import (
    BankedConvBEERS,
    ConvBEERS,
    Rounding,
    TrainableNetwork,
    load_network,
)
from beers_deploy.model.io.files import sha256
from beers_deploy.model.metrics.perceptual import Lpips, find_backbone, not_found
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.simulator.chart import draw_charts
from beers_deploy.model.simulator.procedural import draw_scenes
from beers_deploy.model.simulator.sampling import Scene, read_scene
from beers_deploy.model.training.checkpoint import TrainingRecipe, finish, require_finite_output
from beers_deploy.model.training.grow import grow
from beers_deploy.model.training.losses import RestorationLoss
from beers_deploy.model.training.patches import PatchRecipe, pair_files
from beers_deploy.model.training.source import PatchSource, StoredPairs
from beers_deploy.model.training.trainer import Batches, Precision, Schedule, Trainer, Worker
from beers_deploy.model.training.validation import Validation, split_by_site, write_picture
from beers_deploy.model.variants import variant_named
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor, numbers_of

logger = logging.getLogger(__name__)

STEP = re.compile(r"[0-9]{1,18}(?=,)")
"""The step at the beginning of a line of a log."""

SENSOR_VIEWS = 4
"""The number of sensors that view each validation image if the network is conditioned: these
sensors differ by far more than the draws of one.
"""


@dataclass(frozen=True)
class Run:
    """One training run: the options of `train`, or one stage of a recipe.

    Attributes:
        variant: the name of the network's size.
        recipe: the schedule and the seed.
        patches: how patches are made, and from which sensors.
        images: the scenes from which patches are simulated.
        pairs: a folder of stored pairs to learn from instead; None for none.
        out: the folder of the run.
        drawn: the number of scenes to draw in addition.
        charts: the number of charts to draw in addition.
        held_out: the sites that are not trained on; if none is named, a twentieth of the images is
            held out.
        lpips: the weights of SqueezeNet for LPIPS, or their folder; None searches for them.
        start: the weights to start from; None draws new ones.
        validate_steps: the number of steps between two validations.
        device: the device that computes the steps.
        precision: the number format of the body.
        rounding: the steps by which maps are rounded; None does not round them.
    """

    variant: str
    recipe: TrainingRecipe
    patches: PatchRecipe
    images: tuple[Path, ...]
    pairs: Path | None
    out: Path
    drawn: int = 0
    charts: int = 0
    held_out: tuple[str, ...] = ()
    lpips: Path | None = None
    start: Path | None = None
    validate_steps: int = 1000
    device: str = "cpu"
    precision: Precision = "float32"
    rounding: Rounding | None = None

    @property
    def checkpoint(self) -> Path:
        """The file from which the run can be resumed."""
        return self.out / "checkpoint.safetensors"

    @property
    def weights(self) -> Path:
        """The file to which the averaged weights are written at the end."""
        return self.out / f"{self.variant}.safetensors"


def train(run: Run, resume: bool, worker: Worker) -> None:
    """Train a network to the last step, and write its weights and its log.

    Args:
        run: the options of the run.
        resume: True to continue from the checkpoint of the run.
        worker: the rank of this process among those that train together.
    """
    variant = variant_named(run.variant)
    if run.patches.patch_px % variant.scale:
        raise OptionError(
            f"`patch` must be a multiple of {variant.scale} px for a network at 1/{variant.scale} "
            f"resolution, but it is {run.patches.patch_px} px."
        )
    loss, message = loss_of(run)
    if message and worker.first:
        logger.info(message)
    generator = torch.Generator().manual_seed(run.recipe.seed)
    start = grow(_given(run, run.start), variant, generator) if run.start else None
    trainer = Trainer(
        variant,
        run.recipe,
        loss,
        worker,
        device=run.device,
        start=start,
        precision=run.precision,
        conditioned=run.patches.family is not None,
        rounding=run.rounding,
    )
    if loss.perceptual is not None:
        loss.perceptual.to(trainer.device)
    trainer.data = data_sha256(run, loss)
    if resume and not run.checkpoint.exists():
        raise OptionError(
            f"`resume` has no run to continue: no such file {run.checkpoint}. Leave `resume` out "
            "to begin one, or give its folder."
        )
    if resume:
        trainer.resume(run.checkpoint)
    elif run.checkpoint.exists():
        raise OptionError(
            f"`out` already contains a training: {run.checkpoint}. Add `resume`, or choose another "
            "folder."
        )
    batches, validation, names = data(run, trainer)
    _train(run, trainer, batches, validation)
    if worker.first:
        recipe = about(run, names, validation.names, loss) | {"precision": run.precision}
        finish(trainer.averaged(), run.weights, recipe)


def _given(run: Run, path: Path) -> TrainableNetwork:
    """Load a network of the kind that the run trains, or raise an error if it does not fit.

    A network that returns NaN is rejected too, because it would in every step.
    """
    network, _ = load_network(path)
    kind = ConvBEERS if run.patches.family is None else BankedConvBEERS
    if not isinstance(network, kind):
        kinds = ["plain", "conditioned"]
        own, other = kinds if kind is ConvBEERS else reversed(kinds)
        raise ModelError(
            f"{path} holds the weights of a {other} network, but this training is of a {own} one. "
            f"Give weights of a {own} network, or add or remove `conditioned`."
        )
    if run.rounding is not None and network.variant != variant_named(run.variant):
        raise OptionError(
            f"`rounding` needs weights of {run.variant}, but {path} has {network.variant.blocks} "
            f"blocks of {network.variant.features} features. Train a network of that size first, "
            "and make its INT8 file."
        )
    # Finite weights may still give NaN, and then would in every step.
    require_finite_output(network, str(path), "Give another network.")
    return network


def loss_of(run: Run) -> tuple[RestorationLoss, str]:
    """Build the loss of the recipe, and a sentence on whether LPIPS is part of it."""
    if not run.recipe.loss.lpips:
        return RestorationLoss(run.recipe.loss), ""
    backbone = find_backbone("squeeze", run.lpips)
    if backbone is None:
        message = f"trains WITHOUT the LPIPS term: {not_found('squeeze')}"
        return RestorationLoss(run.recipe.loss), message
    perceptual = Lpips.load("squeeze", backbone)
    return RestorationLoss(run.recipe.loss, perceptual), f"LPIPS term over {backbone.name}"


def data_sha256(run: Run, loss: RestorationLoss) -> str:
    """Return one digest of all data that a run learns from, because a resumed run must learn from
    the same.

    Args:
        run: the options of the run.
        loss: the loss, with or without LPIPS, whose weights may be missing when the run is resumed.
    """
    patches = run.patches
    files = image_files(run)
    for pair in pair_files(run.pairs) if run.pairs else []:
        files += pair
    weights = [path for path in (run.start, run.lpips) if path and path.is_file()]
    content = [
        *(numbers_of(sensor) for sensor in (patches.degraded, patches.reference)),
        patches.family,
        (
            patches.patch_px,
            patches.oversamplings,
            patches.looks,
            patches.margin_px,
            patches.noisy_reference,
        ),
        (run.drawn, run.charts, run.held_out),
        loss.perceptual is not None,
        *((file.name, sha256(file)) for file in (*files, *weights)),
    ]
    return hashlib.sha256(repr(content).encode()).hexdigest()


def data(run: Run, trainer: Trainer) -> tuple[Batches, Validation, list[str]]:
    """Prepare the training data of a run.

    Returns:
        The source of batches, the validation, and the names of the training images.
    """
    recipe = run.recipe
    worker = trainer.worker
    sensors = (run.patches.family or run.patches.degraded, run.patches.reference)
    if run.pairs is not None:
        files = pair_files(run.pairs)
        source = StoredPairs(
            files,
            run.patches.degraded,
            run.patches.patch_px,
            recipe.batch,
            recipe.seed,
            worker.rank,
            worker.count,
        )
        return source.batches, Validation([], *sensors), [degraded.name for degraded, _ in files]
    images = image_files(run)
    # The split may be refused, so it comes before the images are read.
    training, held_out = split_by_site([file.name for file in images], run.held_out)
    scenes = read_scenes(images, run.patches.reference)
    views = SENSOR_VIEWS if run.patches.family else 1
    held_out_scenes = list[Scene]()
    for number in held_out:
        held_out_scenes += [scenes[number]] * views
    validation = Validation(held_out_scenes, *sensors)
    synthetic = draw_scenes(run.drawn, recipe.seed) + draw_charts(run.charts, recipe.seed)
    train_on = [scenes[number] for number in training] + synthetic
    if not train_on:
        raise OptionError(
            "No image is left to train on. Give `images`, `pairs` or `drawn`, or hold out fewer "
            "sites."
        )
    patches = PatchSource(
        train_on,
        run.patches,
        recipe.batch,
        recipe.seed,
        worker.rank,
        worker.count,
        trainer.device,
    )
    if patches.unused and worker.first:
        logger.warning(
            "%d of the %d training images are too small for a patch of %d px and are not used, "
            "such as %s",
            len(patches.unused),
            len(train_on),
            run.patches.patch_px,
            patches.unused[0],
        )
    return patches.batches, validation, [scene.name for scene in train_on]


def image_files(run: Run) -> list[Path]:
    """List the images in the folders of the run."""
    return list(chain.from_iterable(map(list_images, run.images)))


def read_scenes(files: Sequence[Path], reference: Sensor) -> list[Scene]:
    """Read images as scenes of the reference sensor."""
    if not files:
        return []
    scenes = []
    with steps("reading", len(files)) as bar:
        for file in files:
            scenes.append(read_scene(file, reference.nominal()))
            bar.advance()
    return scenes


def _train(run: Run, trainer: Trainer, batches: Batches, validation: Validation) -> None:
    log = Log(run.out / "log.csv", trainer.step)
    scores = Log(run.out / "validation.csv", trainer.step)
    with steps("training", run.recipe.steps) as bar:
        bar.advance(trainer.step)

        def report(
            step: int, terms: Mapping[str, float], patches_per_s: float, waited: float
        ) -> None:
            log.write(step, {**terms, "patches_per_s": patches_per_s, "waited": waited})
            means = ", ".join(f"{name} {value:.5f}" for name, value in terms.items())
            rate = f"{patches_per_s:.0f} patches/s in {run.precision}, waits {waited:.0%}"
            bar.advance(step - bar.done, f"{means}, {rate}")

        def validate(step: int, network: TrainableNetwork) -> None:
            require_finite_output(network, f"The network at training step {step}")
            restored = validation.restore(network)
            scores.write(step, validation.judge(restored))
            write_picture(validation, restored, run.out / "validation.png")

        every = run.validate_steps if validation.pairs else 0
        schedule = Schedule(validate_steps=every, report=report, validate=validate)
        try:
            trainer.run(batches, run.checkpoint, schedule)
        except KeyboardInterrupt:
            words = "stopped at step %d of %d; run it again with `resume` to go on"
            logger.warning(words, trainer.step, run.recipe.steps)
            raise


class Log:
    """The log of a training: a CSV file with one line for each report of progress.

    When a run is resumed, lines beyond its step are removed.
    """

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        if path.exists():
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            # A run that was killed may have written lines after its last checkpoint.
            entries = [
                line for line in lines if not (number := STEP.match(line)) or int(number[0]) <= step
            ]
            path.write_text(
                "".join(f"{line}\n" for line in entries if step), encoding="utf-8", newline=""
            )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Add a line, and the header where there is none."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8", newline="") as file:
            lines = csv.writer(file, lineterminator="\n")
            if file.tell() == 0:
                lines.writerow(["step", *values])
            lines.writerow([step, *(f"{value:.6g}" for value in values.values())])


def about(
    run: Run, images: Sequence[str], held_out: Sequence[str], loss: RestorationLoss
) -> dict[str, object]:
    """Return the facts of a run for the header of its weights: everything but the machine."""
    patches = run.patches
    lpips = "squeeze" if loss.perceptual is not None else "left out: no weights"
    if not run.recipe.loss.lpips:
        lpips = "left out: its weight is 0"
    return {
        "training": asdict(run.recipe),
        "lpips": lpips,
        "start": run.start.name if run.start else "drawn weights",
        "degraded": patches.degraded.name if patches.family is None else "drawn over the ranges",
        "reference": patches.reference.name,
        "patch_px": patches.patch_px,
        "oversamplings": patches.oversamplings if run.pairs is None else "as stored",
        "looks": asdict(patches.looks) if run.pairs is None else "as stored",
        "images": list(images),
        "held_out": list(dict.fromkeys(held_out)),
    }
