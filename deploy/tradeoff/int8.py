"""INT8 files that a study lacks: made from float networks on patches of the sensor that they were trained for."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import onnx

from deploy.defaults import load_scenes
from deploy.tradeoff.cache import digest_of
from deploy.tradeoff.networks import operations_per_px, shape_of
from deploy.tradeoff.points import LEGAL
from model.files import sha256
from model.images import list_images
from profiles import load_sensor, sensor_names
from profiles.sensor import reference_for
from quant.calibration import Patches, draw_patches
from quant.free import free_ticks, quantise_free
from quant.onnx_file import metadata
from quant.passes.equalise import search_steps
from quant.quantise import SEARCH_CROPS, quantise_model, ticks

PATCHES, PATCH_PX = 32, 96
"""Fewer and smaller than `quantize` takes: several networks are made in one sitting."""

SEARCH_MAX = 3e13
"""Operations that the search for INT8 free may take: the paper's network would take five times as many."""


@dataclass(frozen=True)
class Calibration:
    """Where calibration patches come from: a folder of scenes, or drawn ones; never the images of the study."""

    scenes: Path | None
    sensor: str
    seed: int

    @cached_property
    def scenes_digest(self) -> str:
        """Of the folder's images; drawn scenes follow from the seed."""
        return digest_of([sha256(path) for path in list_images(self.scenes)] if self.scenes else [])

    def key(self, model: onnx.ModelProto) -> dict[str, object]:
        """What the patches for a network depend on."""
        profile, size = load_sensor(self.sensor_of(model)), [PATCHES, PATCH_PX]
        return {"scenes": self.scenes_digest, "sensor": repr(profile), "seed": self.seed, "size": size}

    def sensor_of(self, model: onnx.ModelProto) -> str:
        """The profile that a network says it was trained for; the study's where it says nothing known."""
        named = metadata(model).get("sensor", "")
        return named if named in sensor_names() else self.sensor

    def patches(self, model: onnx.ModelProto) -> Patches:
        """For one network."""
        degraded = load_sensor(self.sensor_of(model))
        reference = reference_for(degraded)
        scenes = load_scenes(self.scenes, reference.nominal(), self.seed)
        return draw_patches(scenes, degraded, reference, PATCHES, self.seed, PATCH_PX)


def make_int8(
    model: onnx.ModelProto, precision: str, calibration: Calibration, tick: Callable[[], None]
) -> onnx.ModelProto:
    """The network in INT8, host spelling.

    Raises:
        ModelError: not a graph of convolutions, ReLUs and adds that ends with the global add.
        ImageError: no scene holds a patch.
    """
    patches = calibration.patches(model)
    about = {"calibration_sensor": calibration.sensor_of(model), "calibration_seed": str(calibration.seed)}
    if precision == LEGAL:
        return quantise_model(model, patches, about, tick).host
    return quantise_free(model, patches, about, tick)


def int8_ticks(model: onnx.ModelProto, precision: str) -> int:
    """How often `make_int8` will call `tick`."""
    return ticks(model, PATCHES) if precision == LEGAL else free_ticks(model, PATCHES)


def search_operations(model: onnx.ModelProto) -> float:
    """What the search for equal channels computes: most of the work of making an INT8 file."""
    pixels = SEARCH_CROPS * PATCH_PX**2
    return float(search_steps(shape_of(model)[1])) * pixels * operations_per_px(model)
