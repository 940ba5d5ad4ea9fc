"""Test that the benchmark of the self-check prints its line whatever the flips cost."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import self_check


def test_flips_that_cost_no_block_have_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = np.random.default_rng(0).integers(60, 200, (240, 240), np.uint8)
    Image.fromarray(scene).save(tmp_path / "scene.png")
    monkeypatch.setattr(self_check, "COSTLY_DB", 1000.0)
    line = self_check.flips(tmp_path, "convbeers-xs-int8", 1)
    assert "1 flips" in line
    assert line.endswith("none costs a decidable block more than 1000 dB")
