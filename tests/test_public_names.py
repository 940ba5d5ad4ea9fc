"""Tests of the library's public names: a change here affects everyone who imports them."""

import subprocess
import sys

import beers_deploy as bd

NAMES = (
    "BeersError Board Limits Network Pair Sensor Table bench boards characterize check compare "
    "demo evaluate export gate golden networks quantize restore sensors simulate stress "
    "tradeoff train"
)
LIGHT = (
    "beers_deploy",
    "beers_deploy.profiles",
    "beers_deploy.model.raster.images",
    "beers_deploy.quant",
)
"""Modules that are imported by commands that need no torch."""


def test_the_library_offers_these_names_and_no_others() -> None:
    names = vars(bd)["__all__"]
    assert sorted(names) == NAMES.split()
    assert all(hasattr(bd, name) for name in names)


def test_light_modules_import_no_heavy_package() -> None:
    heavy = "{'torch', 'skimage', 'scipy', 'matplotlib', 'onnxruntime'}"
    code = f"import sys, {', '.join(LIGHT)}; print({heavy} & set(sys.modules))"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "set()"
