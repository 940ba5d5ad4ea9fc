"""What the packages offer by name: a change here is a change for whoever imports them."""

import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import pytest

SURFACE = {
    "beers_deploy.profiles": (
        "BeersError Figure Instrument Row SceneCall Sensor TargetProfile load_scene_call load_sensor "
        "load_target scene_names sensor_names target_names"
    ),
    "beers_deploy.model.io": (
        "list_images open_tiff read_pixels require_writable settled_scale sha256 site_of whole_file write_text"
    ),
    "beers_deploy.model.metrics": "Refusal psnr_db site_interval ssim",
    "beers_deploy.model.simulator": (
        "Draw Pair Plan Scene make_plan procedural_scene read_scene resample sensor_transfer simulate_pair to_dn "
        "to_radiance"
    ),
    "beers_deploy.model.traditional": (
        "Chain Noise PEERS QUALITIES destabilise restore_strips restore_traditional stabilise"
    ),
    "beers_deploy.model.training": "PatchRecipe RestorationLoss Run TrainingRecipe train",
    "beers_deploy.quant": (
        "Calibration GateResult IntCore Limits Patches Quantised Tiling board_model compare draw_patches "
        "host_model judge load_onnx open_session quantise_free quantise_model read_core run "
        "save_onnx tiling_of unseen_patches"
    ),
    "beers_deploy": (
        "BeersError Board Limits Network Pair Sensor Table boards characterize check compare evaluate gate networks "
        "predict quantize restore sensors simulate tradeoff"
    ),
}
LIGHT = tuple(
    name
    for name in SURFACE
    if name.rpartition(".")[2] in {"beers_deploy", "profiles", "model", "io", "metrics", "quant"}
)
"""Looked at by commands that need no torch."""


@pytest.mark.parametrize("package", SURFACE)
def test_a_package_offers_these_names_and_no_others(package: str) -> None:
    found = import_module(package)
    assert sorted(found.__all__) == SURFACE[package].split()
    assert all(hasattr(found, name) for name in found.__all__)


@pytest.mark.parametrize("package", SURFACE)
def test_no_offered_name_hides_a_module(package: str) -> None:
    """`from beers_deploy.model.simulator import mtf` must mean the file, wherever it stands."""
    assert not set(SURFACE[package].split()) & {
        module.name for module in iter_modules(import_module(package).__path__)
    }


def test_packages_are_looked_at_without_torch() -> None:
    heavy = "{'torch', 'skimage', 'matplotlib', 'onnxruntime'}"
    code = f"import sys, {', '.join(LIGHT)}; print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
