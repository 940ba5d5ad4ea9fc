"""What the packages offer by name is there, and looking for it loads no torch where none is needed."""

import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import pytest

OFFERING = ("profiles", "model.io", "model.metrics", "model.simulator", "model.traditional")


@pytest.mark.parametrize("package", OFFERING)
def test_every_offered_name_is_there_once(package: str) -> None:
    found = import_module(package)
    assert all(hasattr(found, name) for name in found.__all__)
    assert len(found.__all__) == len(set(found.__all__))


@pytest.mark.parametrize("package", OFFERING)
def test_no_offered_name_hides_a_module(package: str) -> None:
    """`from model.simulator import mtf` must mean the file, wherever it stands."""
    found = import_module(package)
    assert not set(found.__all__) & {module.name for module in iter_modules(found.__path__)}


@pytest.mark.parametrize("package", ["profiles", "model", "model.io", "model.metrics", "model.training"])
def test_a_package_is_looked_at_without_torch(package: str) -> None:
    code = f"import sys, {package}; print({{'torch', 'skimage', 'onnxruntime'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
