"""What is shipped is found without loading what is not needed."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import tifffile

from deploy.networks import shipped_pair


def test_the_shipped_files_are_there() -> None:
    assert shipped_pair()[1].is_file()
    assert shipped_pair()[0].is_file()


def test_restoring_with_the_shipped_network_needs_neither_torch_nor_scikit_image(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", np.full((30, 20), 900, np.uint16))
    call = f"app(['restore', {str(tmp_path / 'in.tif')!r}, {str(tmp_path / 'out.tif')!r}], standalone_mode=False)"
    code = f"import sys; from deploy.cli import app; {call}; print({{'torch', 'skimage'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"
    assert tifffile.imread(tmp_path / "out.tif").shape == (30, 20)
