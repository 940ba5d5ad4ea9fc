"""A training run from options to a folder: checkpoint, logs, validation pictures, weights with
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

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from beers_deploy.model.bank import network_bank
from beers_deploy.model.convbeers import (
    BankedConvBEERS,
    ConvBEERS,
    Network,
    Rounding,
    grow,
    load_network,
    told,
    vector_tensor,
)
from beers_deploy.model.family import SensorFamily
from beers_deploy.model.io.files import sha256, whole_file
from beers_deploy.model.io.pictures import busiest_windows, grid, stretch_of, strip_row
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.metrics.perceptual import Lpips, find_backbone, not_found
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import list_images, site_of
from beers_deploy.model.simulator.acquire import LEAST_SIDE_PX, fitting_oversampling, simulate_pair
from beers_deploy.model.simulator.chart import draw_charts
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import draw_scenes
from beers_deploy.model.simulator.sampling import Scene, read_scene
from beers_deploy.model.training.checkpoint import TrainingRecipe, finish, require_finite_output
from beers_deploy.model.training.losses import RestorationLoss
from beers_deploy.model.training.patches import PatchRecipe, pair_files
from beers_deploy.model.training.source import PatchSource
from beers_deploy.model.training.stored import StoredPairs
from beers_deploy.model.training.trainer import Batches, Precision, Schedule, Speed, Trainer, Worker
from beers_deploy.model.variants import Variant, variant_named
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor, numbers_of

logger = logging.getLogger(__name__)

STEP = re.compile(r"[0-9]{1,18}(?=,)")
"""What a line of a log begins with."""

VALIDATION_CROP_PX = 96
ZOOM = 2

SENSOR_VIEWS = 4
"""Sensors that each validation image is seen by where the network is conditioned: they differ by
far more.
"""


@dataclass(frozen=True)
class Run:
    """What the command's options say, or a stage of a recipe.

    Attributes:
        held_out: sites that are not trained on; where none is named, a twentieth of the images is.
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
        """Where the run can be resumed from."""
        return self.out / "checkpoint.safetensors"

    @property
    def weights(self) -> Path:
        """Where the averaged weights go in the end."""
        return self.out / f"{self.variant}.safetensors"


SHARE = 0.05
"""Of the images: sites are held out, the ones with the fewest images first, until so many are."""

SIDE_PX = 192
OVERSAMPLINGS = (4, 3, 2, 1)


def split_by_site(names: Sequence[str], wanted: Sequence[str] = ()) -> tuple[list[int], list[int]]:
    """Numbers of the images to train on, and of those held out: whole sites, always the same ones.

    Args:
        names: of the images.
        wanted: sites to hold out; without any, those with the fewest images are, and of fewer than
            three none is.

    Raises:
        OptionError: no image shows a wanted site.
    """
    sites: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        sites.setdefault(site_of(name), []).append(number)
    held_out: list[int] = []
    for site in wanted:
        if site not in sites:
            raise OptionError(
                f"The site {site!r} is to be held out, but no image shows it. Give the folders of "
                "all its images."
            )
        held_out += sites[site]
    if len(sites) >= 3 and not wanted:
        # The name decides between sites of one size, so that the split is always the same.
        for site in sorted(sites, key=lambda s: (len(sites[s]), s)):
            if len(held_out) >= SHARE * len(names):
                break
            held_out += sites[site]
    return [n for n in range(len(names)) if n not in held_out], sorted(held_out)


class Validation:
    """Pairs (1, 1, H, W) in [0, 1] from scenes that are not trained on, the same in every run.

    Scenes too small to leave anything within the margin are left out.
    """

    def __init__(
        self, scenes: Sequence[Scene], degraded: Sensor | SensorFamily, reference: Sensor
    ) -> None:
        self.names = list[str]()
        self.pairs = list[tuple[Tensor, Tensor]]()
        self.sensors = list[Instrument]()
        for number, scene in enumerate(scenes):
            ratio = fitting_oversampling(scene.radiance, OVERSAMPLINGS, LEAST_SIDE_PX)
            if ratio is None:
                continue
            # Seed 0 whatever that of the run: validation is the same in every run.
            draw = Draw(0, number)
            sensors = [profile.draw(draw.generator("sensor")) for profile in (degraded, reference)]
            pair = simulate_pair(scene.radiance, sensors[0], sensors[1], ratio, draw)
            height, width = (min(side, SIDE_PX) for side in pair.degraded.shape)
            both = (pair.degraded / sensors[0].max_dn, pair.reference / sensors[1].max_dn)
            degraded_image, reference_image = (
                torch.from_numpy(image[None, None, :height, :width]) for image in both
            )
            self.names.append(scene.name)
            self.pairs.append((degraded_image, reference_image))
            self.sensors.append(sensors[0])

    def restore(self, network: Network) -> list[np.ndarray]:
        """Each degraded image through the network in float32, (H, W), clipped to [0, 1].

        A conditioned network is told the sensor that acquired the image. An image whose sides are
        no multiples of the network's scale is extended by copies of its last row and column, as in
        a restoration.
        """
        restored = []
        for (degraded, _), sensor in zip(self.pairs, self.sensors, strict=True):
            for_sensor = told(network, vector_tensor(sensor), network_bank(sensor))
            height, width = degraded.shape[-2:]
            right = -width % for_sensor.variant.scale
            below = -height % for_sensor.variant.scale
            extended = pad(degraded, [0, right, 0, below], mode="replicate")
            with torch.inference_mode():
                restored.append(for_sensor(extended)[0, 0, :height, :width].clamp(0, 1).numpy())
        return restored

    def judge(self, network: Network) -> dict[str, float]:
        """Means over the pairs of a network on the CPU, PSNR over full scale: by the names of a
        log's columns.
        """
        restored = self.restore(network)
        references = [reference[0, 0].numpy() for _, reference in self.pairs]
        inputs = [degraded[0, 0].numpy() for degraded, _ in self.pairs]
        judged = {
            "psnr_db": (psnr_db, restored),
            "degraded_psnr_db": (psnr_db, inputs),
            "ssim": (ssim, restored),
        }
        return {
            name: float(
                np.mean([score(a, b, 1.0) for a, b in zip(images, references, strict=True)])
            )
            for name, (score, images) in judged.items()
        }


def train(run: Run, resume: bool, worker: Worker) -> None:
    """Run or resume a training to its end, and log whether LPIPS is part of the loss."""
    variant = variant_named(run.variant)
    require_whole_places(run, variant)
    loss, message = loss_of(run)
    if message and worker.first:
        logger.info(message)
    generator = torch.Generator().manual_seed(run.recipe.seed)
    start = grow(_given(run, run.start), variant, generator) if run.start else None
    conditioned = run.patches.family is not None
    options = (run.device, start, run.precision, conditioned, run.rounding)
    trainer = Trainer(variant, run.recipe, loss, worker, *options)
    if loss.perceptual is not None:
        loss.perceptual.to(trainer.device)
    trainer.data = data_sha256(run, loss)
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


def require_whole_places(run: Run, variant: Variant) -> None:
    """Raise OptionError if a network at a lower resolution cannot rearrange the patches."""
    if run.patches.patch_px % variant.scale:
        raise OptionError(
            f"`patch` must be a multiple of {variant.scale} px for a network at 1/{variant.scale} "
            f"resolution, but it is {run.patches.patch_px} px."
        )


def _given(run: Run, path: Path) -> Network:
    """A network from its file, of the kind that the run trains; refused where it gives NaN, as
    every step would.
    """
    network, _ = load_network(path)
    kind = ConvBEERS if run.patches.family is None else BankedConvBEERS
    if not isinstance(network, kind):
        if kind is ConvBEERS:
            raise ModelError(
                f"{path} holds the weights of a conditioned network, but this training is of a "
                "plain one. Give other weights, or add `conditioned`."
            )
        raise ModelError(
            f"{path} holds the weights of a plain network, but this training is of a conditioned "
            "one. Give weights that were trained with `conditioned`."
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
    """The loss of the recipe, and a sentence on whether LPIPS is part of it."""
    if not run.recipe.loss.lpips:
        return RestorationLoss(run.recipe.loss), ""
    backbone = find_backbone("squeeze", run.lpips)
    if backbone is None:
        return RestorationLoss(
            run.recipe.loss
        ), f"trains WITHOUT the LPIPS term: {not_found('squeeze')}"
    perceptual = Lpips.load("squeeze", backbone)
    return RestorationLoss(run.recipe.loss, perceptual), f"LPIPS term over {backbone.name}"


def data_sha256(run: Run, loss: RestorationLoss) -> str:
    """Return one digest of all that a run learns from: a resumed run must learn from the same, or
    it is none.

    Args:
        run: what the options say.
        loss: with or without LPIPS, whose weights may be missing at the second time.
    """
    patches = run.patches
    files = list(chain.from_iterable(map(list_images, run.images)))
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
    """Where batches come from, the images held out, and the names of those trained on."""
    recipe = run.recipe
    sensors = (run.patches.family or run.patches.degraded, run.patches.reference)
    if run.pairs is not None:
        files = pair_files(run.pairs)
        degraded = run.patches.degraded
        nominal = degraded.nominal()
        mirrors, alike = nominal.symmetry
        # Axes that are drawn from two ranges differ, even where the middles of the ranges agree.
        turns = alike and degraded.mtf_nyquist_along is None
        source = StoredPairs(
            files,
            run.patches.patch_px,
            nominal.max_dn,
            recipe.batch,
            recipe.seed,
            trainer.worker.rank,
            trainer.worker.count,
            turns,
            mirrors,
        )
        return source.batches, Validation([], *sensors), [degraded.name for degraded, _ in files]
    scenes = read_scenes(run)
    training, held_out = split_by_site([scene.name for scene in scenes], run.held_out)
    views = SENSOR_VIEWS if run.patches.family else 1
    held_out_scenes = list[Scene]()
    for number in held_out:
        held_out_scenes += [scenes[number]] * views
    validation = Validation(held_out_scenes, *sensors)
    synthetic = draw_scenes(run.drawn, recipe.seed) + draw_charts(run.charts, recipe.seed)
    train_on = [scenes[number] for number in training] + synthetic
    if not train_on:
        raise OptionError("There is nothing to train on. Give `images`, `pairs` or `drawn`.")
    worker = trainer.worker
    ranks = worker.rank, worker.count
    patches = PatchSource(train_on, run.patches, recipe.batch, recipe.seed, *ranks, trainer.device)
    return patches.batches, validation, [scene.name for scene in train_on]


def read_scenes(run: Run) -> list[Scene]:
    """The images of the run's folders."""
    files = list(chain.from_iterable(map(list_images, run.images)))
    scenes = list[Scene]()
    if not files:
        return []
    with steps("reading", len(files)) as bar:
        for file in files:
            scenes.append(read_scene(file, run.patches.reference.nominal()))
            bar.advance()
    return scenes


def _train(run: Run, trainer: Trainer, batches: Batches, validation: Validation) -> None:
    log = Log(run.out / "log.csv", trainer.step)
    scores = Log(run.out / "validation.csv", trainer.step)
    with steps("training", run.recipe.steps) as bar:
        bar.advance(trainer.step)

        def report(step: int, terms: Mapping[str, float], speed: Speed) -> None:
            log.write(step, {**terms, "patches_per_s": speed.patches_per_s, "waited": speed.waited})
            means = ", ".join(f"{name} {value:.5f}" for name, value in terms.items())
            rate = (
                f"{speed.patches_per_s:.0f} patches/s in {run.precision}, waits {speed.waited:.0%}"
            )
            bar.advance(step - bar.done, f"{means}, {rate}")

        def validate(step: int, network: Network) -> None:
            require_finite_output(network, f"The network at training step {step}")
            judged = validation.judge(network)
            scores.write(step, judged)
            write_picture(validation, network, run.out / "validation.png")

        every = run.validate_steps if validation.pairs else 0
        trainer.run(
            batches,
            run.checkpoint,
            Schedule(validate_steps=every, report=report, validate=validate),
        )


class Log:
    """A CSV file that grows by a line a report; lines beyond the step that a run resumes from are
    dropped.
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


def write_picture(validation: Validation, network: Network, path: Path) -> None:
    """The busiest crop of each validation image: degraded, restored, reference."""
    rows: list[list[np.ndarray]] = []
    for (degraded, reference), restored in zip(
        validation.pairs, validation.restore(network), strict=True
    ):
        images = [degraded[0, 0].numpy(), restored, reference[0, 0].numpy()]
        side = min(VALIDATION_CROP_PX, *images[0].shape)
        top, left = busiest_windows(images[2], side)[0]
        crops = (image[top : top + side, left : left + side] for image in images)
        rows.append(strip_row(crops, stretch_of(images[2])))
    # Scenes may have other sizes, and the cells of a grid have one.
    smallest = min(row[0].shape for row in rows)
    cells = [[cell[: smallest[0], : smallest[1]] for cell in row] for row in rows]
    with whole_file(path) as temporary:
        grid(["degraded", "restored", "reference"], cells, ZOOM).save(
            temporary, "PNG", optimize=True
        )


def about(
    run: Run, images: Sequence[str], held_out: Sequence[str], loss: RestorationLoss
) -> dict[str, object]:
    """The recipe kept in the weights' header: everything but the machine."""
    patches = run.patches
    return {
        "training": asdict(run.recipe),
        "lpips": "squeeze" if loss.perceptual is not None else "left out: no weights",
        "start": run.start.name if run.start else "drawn weights",
        "degraded": patches.degraded.name if patches.family is None else "drawn over the ranges",
        "reference": patches.reference.name,
        "patch_px": patches.patch_px,
        "oversamplings": patches.oversamplings if run.pairs is None else "as stored",
        "looks": asdict(patches.looks) if run.pairs is None else "as stored",
        "images": list(images),
        "held_out": list(dict.fromkeys(held_out)),
    }
