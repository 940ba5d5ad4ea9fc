"""`beers-deploy train`: make a network's weights from images and two sensor profiles."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from model.patches import PatchRecipe
    from model.training import TrainingRecipe

EXAMPLE = "train --variant convbeers-s --images aerial/ --out runs/s --steps 20000"


def train(
    images: Annotated[Path, typer.Option(help="Folder of sharp aerial images (8-bit RGB, or 16-bit mono).")],
    out: Annotated[Path, typer.Option(help="Folder of the run: checkpoint, log and weights.")],
    variant: Annotated[str, typer.Option(help="Size of the network.")] = "convbeers-s",
    sensor: Annotated[str, typer.Option(help="Profile of the degraded input.")] = "pleiades-variable",
    reference: Annotated[str, typer.Option(help="Profile of the wanted output.")] = "pleiades-reference",
    drawn: Annotated[int, typer.Option(min=0, help="Drawn scenes to add to the images.")] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Gradient steps.")] = 20_000,
    batch: Annotated[int, typer.Option(min=1, help="Patches a step.")] = 8,
    patch: Annotated[int, typer.Option(min=16, help="Patch side in pixels.")] = 96,
    seed: Annotated[int, typer.Option(min=0, help="Seed of weights and patches.")] = 0,
    device: Annotated[str, typer.Option(help="Torch device.")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
) -> None:
    """Train a network on pairs simulated on the fly; resumable, the same weights for the same seed."""
    from deploy.defaults import draw_scenes
    from deploy.progress import steps as progress
    from model.files import require_writable
    from model.images import list_images
    from model.patches import PatchRecipe, PatchSource
    from model.simulator.scene import read_scene
    from model.training import Progress, Trainer, TrainingRecipe, finish
    from model.weights_file import variant_named
    from profiles import load_sensor
    from profiles.errors import OptionError

    shape = variant_named(variant)
    recipe = PatchRecipe(load_sensor(sensor), load_sensor(reference), patch_px=patch)
    files = list_images(images)
    require_writable(out / f"{variant}.safetensors")
    trainer = Trainer(shape, TrainingRecipe(steps=steps, batch=batch, seed=seed), device)
    checkpoint = out / "checkpoint.safetensors"
    if resume:
        trainer.resume(checkpoint)
    elif checkpoint.exists():
        raise OptionError(
            "--out", expected="a folder without a run", got=str(checkpoint), remedy="add --resume or choose another"
        )
    with progress("reading", len(files)) as bar:
        scenes = []
        for file in files:
            scenes.append(read_scene(file, recipe.reference.nominal()))
            bar.advance()
    scenes += draw_scenes(drawn, seed)
    source = PatchSource(scenes, recipe, batch, seed)
    with (out / "log.csv").open("a") as log, progress("training", steps) as bar:
        bar.advance(trainer.step)
        if log.tell() == 0:
            log.write("step,l1,patches_per_s\n")

        def report(now: Progress) -> None:
            log.write(f"{now.step},{now.loss:.6g},{now.patches_per_s:.1f}\n")
            log.flush()
            bar.advance(now.step - bar.done, f"L1 {now.loss:.6f}, {now.patches_per_s:.0f} patches/s")

        trainer.run(source, checkpoint, report)
    weights = out / f"{variant}.safetensors"
    finish(trainer, weights, describe(trainer.recipe, recipe, [scene.name for scene in scenes]))
    typer.echo(f"wrote {weights}")


def describe(training: "TrainingRecipe", patches: "PatchRecipe", images: list[str]) -> dict[str, object]:
    """The recipe kept in the weights' header: everything but the machine."""
    from dataclasses import asdict

    return {
        "training": asdict(training),
        "loss": "L1",
        "degraded": patches.degraded.name,
        "reference": patches.reference.name,
        "patch_px": patches.patch_px,
        "oversamplings": patches.oversamplings,
        "exposures": patches.exposures,
        "images": images,
    }
