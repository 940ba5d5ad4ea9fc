"""What commands use when nothing is given: the shipped convbeers-s, and drawn scenes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx

from deploy.export import to_onnx
from deploy.shipped import default_float_weights, float_file
from model.images import list_images
from model.simulator.procedural import procedural_scene
from model.simulator.scene import Scene, read_scene
from model.weights_file import load_network
from profiles.sensor import REFERENCE, Sensor, SensorProfile, describe_units, load_sensor
from quant.onnx_file import load_onnx

SCENES = 3
SCENE_SIDE_PX = 2400
HELD_OUT_SEED = 1000
"""Added to a run's seed where patches must be others than calibration's."""


def float_model(path: Path | None) -> onnx.ModelProto:
    """A float network as ONNX: from an .onnx or a .safetensors file, or the shipped one.

    Raises:
        ModelError: neither of these.
    """
    path = float_file(path) if path else default_float_weights()
    if path.suffix != ".safetensors":
        return load_onnx(path)
    network, recipe = load_network(path)
    return to_onnx(network, about(path.stem, recipe))


def about(variant: str, recipe: dict[str, object]) -> dict[str, str]:
    """What an exported file says of itself."""
    return {
        "variant": variant,
        "sensor": str(recipe.get("degraded", "")),
        "reference": str(recipe.get("reference", "")),
    }


def reference_beside(degraded: SensorProfile, name: str | None, say: Callable[[str], None]) -> SensorProfile:
    """The reference profile that a user named, or the default one, in the digital numbers of `degraded`.

    One that was named, and states other ones, is converted in sight: `say` is told.

    Raises:
        ProfileError: no such profile, or a faulty one.
    """
    stated = load_sensor(name or REFERENCE)
    reference = stated.in_units_of(degraded)
    if name is not None and reference is not stated:
        units = f"{describe_units(degraded)}, as {degraded.name} has them"
        say(f"note: the reference {stated.name} ({describe_units(stated)}) is taken at {units}")
    return reference


def load_scenes(folder: Path | None, sensor: Sensor, seed: int) -> list[Scene]:
    """The scenes of a folder of images, or drawn ones, other for every seed."""
    if folder is not None:
        return [read_scene(path, sensor) for path in list_images(folder)]
    return draw_scenes(SCENES, seed)


def draw_scenes(count: int, seed: int) -> list[Scene]:
    """Drawn scenes, each with its own generator."""
    generators = np.random.default_rng(seed).spawn(count)
    return [procedural_scene(SCENE_SIDE_PX, SCENE_SIDE_PX, g) for g in generators]
