"""Tests of `train --recipe`: stages, INT8 file and model card, the same bytes after an
interruption, and refusals.
"""

from pathlib import Path

import pytest

from beers_deploy.model.io.tensors import read_conditioned, read_tensors
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.sensor_bank.conditioned import required_conditioned_core
from tests.deploy.command_line import done, refused
from tests.deploy.test_training import write_photograph

RECIPE = """
variant = "convbeers-half-xs"
charts = 1
patch_px = 32
other_curves = 0.5
held_out = ["town"]
attribution = ["Drawn for a test, CC0 1.0"]
[looks]
lit_share = 0.5
[loss]
l1 = 0.0
lpips = 0.0
fft = 0.0
psnr = 0.01
coarse = 0.5
[[stages]]
name = "float"
steps = 3
batch = 2
[[stages]]
name = "rounded"
steps = 2
batch = 2
rounding = true
"""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    paths = []
    for number, site in enumerate(("coast_1", "town_1")):
        paths.append(tmp_path_factory.mktemp(site))
        write_photograph(paths[-1] / f"{site}.png", number)
    return paths


@pytest.mark.slow
def test_a_recipe_makes_weights_int8_file_and_card_and_resumes_to_the_same_bytes(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("beers_deploy.quant.sensor_bank.calibrate.PATCHES", 6)
    recipe = tmp_path / "own.toml"
    out = tmp_path / "run"
    recipe.write_text(RECIPE)
    images = "--images", folders[0], "--images", folders[1]
    command = "train", "--recipe", recipe, *images, "--out", out
    assert "--resume has no run to continue" in refused(*command, "--resume")
    done(*command)
    names = [f"own{end}" for end in (".safetensors", "-int8.onnx", ".md")]
    first = [(out / name).read_bytes() for name in names]
    weights = read_conditioned(out / names[0])
    assert weights.kernels == "fitted"
    assert required_conditioned_core(load_onnx(out / names[1])).kernels == "fitted"
    card = (out / names[2]).read_text()
    assert RECIPE.strip() in card
    assert "- Drawn for a test, CC0 1.0" in card
    assert "10 patches of 1 photographs" in card
    assert "train --recipe own.toml --images" in card
    assert f"--images {folders[0].name}/ --images {folders[1].name}/ --out" in card
    trained = read_tensors(out / "1-float" / "convbeers-half-xs.safetensors")[1]["recipe"]
    assert isinstance(trained, dict)
    assert trained["held_out"] == ["town_1.png"]
    # The run now looks as if it had been stopped between the stages, and within the second one
    # before its first checkpoint.
    for name in names:
        (out / name).unlink()
    for path in (out / "2-rounded").iterdir():
        if path.name != "start-int8.onnx":
            path.unlink()
    assert "Add --resume" in refused(*command)
    done(*command, "--resume")
    assert [(out / name).read_bytes() for name in names] == first


def test_a_recipe_needs_images(tmp_path: Path) -> None:
    command = "train", "--recipe", "convbeers-xs", "--out", tmp_path / "run"
    assert "--recipe needs --images" in refused(*command)
    assert not (tmp_path / "run").exists()


def test_a_held_out_site_that_no_folder_shows_is_refused_before_an_image_is_read(
    tmp_path: Path,
) -> None:
    (tmp_path / "own.toml").write_text(RECIPE)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "broken_1.png").write_text("no image")
    command = "train", "--recipe", tmp_path / "own.toml", "--out", tmp_path / "run"
    assert "'town' is to be held out" in refused(*command, "--images", tmp_path / "images")
