"""What the packages offer by name is there, and looking for it loads no torch where none is needed."""

import subprocess
import sys
from importlib import import_module

import pytest

OFFERING = ("profiles", "model.io", "model.metrics", "model.simulator", "model.traditional")


@pytest.mark.parametrize("package", OFFERING)
def test_every_offered_name_is_there_and_in_order(package: str) -> None:
    found = import_module(package)
    assert all(hasattr(found, name) for name in found.__all__)
    assert sorted(found.__all__) == sorted(set(found.__all__))


@pytest.mark.parametrize("package", ["profiles", "model", "model.io", "model.metrics", "model.training"])
def test_a_package_is_looked_at_without_torch(package: str) -> None:
    code = f"import sys, {package}; print({{'torch', 'skimage', 'onnxruntime'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
