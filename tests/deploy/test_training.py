"""Tests of `train` from options to a folder of results."""

import csv
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from beers_deploy.model.convbeers import for_sensor, load_network, save_network
from beers_deploy.model.io.tensors import read_tensors
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.training import run as training
from beers_deploy.model.training.source import StoredPairs
from beers_deploy.model.variants import VARIANTS
from tests.deploy.command_line import done, refused
from tests.model.networks import behind_a_bank
from tests.profiles.own_sensor import own_sensor

SIDE = 420


def write_photograph(path: Path, seed: int) -> None:
    """Write a drawn scene as a camera shows it."""
    radiance = procedural_scene(SIDE, SIDE, np.random.default_rng(seed)).radiance
    grey = np.clip(255 * (radiance / 400) ** (1 / 2.2), 0, 255).astype(np.uint8)
    Image.fromarray(grey).save(path)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for number, site in enumerate(("coast_1", "forest_1", "town_1")):
        write_photograph(folder / f"{site}.png", number)
    return folder


def run(images: Path, out: Path, more: str = "", steps: int = 4) -> str:
    usual = f"--variant convbeers-xs --steps {steps} --batch 2 --patch 32"
    return done(f"train --images {images} --out {out} {usual} {more}")


@pytest.fixture(scope="module")
def finished(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run, which tests only read or copy."""
    folder = tmp_path_factory.mktemp("finished") / "r"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("BEERS_LPIPS_WEIGHTS", raising=False)
        assert "WITHOUT the LPIPS term" in run(images, folder, "--validate-every 2")
    return folder


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_run_writes_logs_pictures_and_weights_with_their_recipe(
    finished: Path,
) -> None:
    assert [row["step"] for row in rows(finished / "validation.csv")] == ["2", "4"]
    assert list(rows(finished / "log.csv")[0]) == ["step", "l1", "fft", "patches_per_s", "waited"]
    with Image.open(finished / "validation.png") as picture:
        assert picture.width > 200
    _, recipe = load_network(finished / "convbeers-xs.safetensors")
    assert recipe["lpips"] == "left out: no weights"
    assert recipe["held_out"] == ["coast_1.png"]
    assert recipe["images"] == ["forest_1.png", "town_1.png"]


def test_a_run_is_not_resumed_with_other_data(images: Path, finished: Path, tmp_path: Path) -> None:
    """With another image, sensor or patch, the weights would be those of no single run."""
    other = Path(shutil.copytree(images, tmp_path / "other"))
    image = sorted(other.glob("*.png"))[0]
    pixels = np.array(Image.open(image))
    pixels.flat[pixels.size // 2] ^= 1
    Image.fromarray(pixels).save(image)
    command = f"train --out {finished} --variant convbeers-xs --steps 4 --batch 2 --patch 32"
    for data in (other, f"{images} --sensor dior-high", f"{images} --drawn 1"):
        message = refused(f"{command} --validate-every 2 --resume --images {data}")
        assert "a training with other images, held-out sites, patches" in message


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--steps 5", "--steps was 4, and is 5"),
        ("--learning-rate 0.1", "--learning-rate was 0.001, and is 0.1"),
        ("--l1-weight 2", "--l1-weight was 1.0, and is 2.0"),
    ],
)
def test_a_run_is_not_resumed_with_other_options(
    option: str, words: str, images: Path, finished: Path
) -> None:
    usual = "--variant convbeers-xs --steps 4 --batch 2 --patch 32 --validate-every 2"
    message = refused(f"train --images {images} --out {finished} {usual} --resume {option}")
    assert words in message


def test_nothing_is_resumed_in_an_empty_folder(images: Path, tmp_path: Path) -> None:
    message = refused(f"train --images {images} --out {tmp_path}/none --resume")
    assert "--resume has no run to continue" in message


def test_pictures_are_not_written_among_the_images(images: Path) -> None:
    """Otherwise the picture of the validation would be an image of the next run."""
    before = sorted(images.iterdir())
    assert "folder of an input" in refused(f"train --images {images} --out {images} --steps 1")
    assert sorted(images.iterdir()) == before


def test_images_that_are_too_small_are_named(images: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(images, tmp_path / "images"))
    Image.new("L", (80, 80)).save(folder / "yard_1.png")
    assert "1 of the " in (said := run(folder, tmp_path / "r", steps=1)), said
    Image.new("L", (40, 80)).save(folder / "yard_1.png")
    message = refused(
        f"train --images {folder} --out {tmp_path}/s --steps 1 --variant convbeers-xs"
    )
    assert "yard_1.png must have at least 60 pixels a side" in message


def test_a_checkpoint_with_a_flipped_bit_is_refused(
    images: Path, finished: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "a"))
    path = folder / "checkpoint.safetensors"
    content = path.read_bytes()
    for damaged in (
        content[:-3000] + bytes([content[-3000] ^ 1]) + content[-2999:],
        content.replace(b'"step":"4"', b'"step":"2"'),
    ):
        assert damaged != content
        path.write_bytes(damaged)
        with pytest.raises(AssertionError, match="does not match its digest"):
            run(images, folder, "--validate-every 2 --resume")


def test_a_conditioned_run_starts_from_other_weights_and_resumes_to_the_same(
    images: Path, tmp_path: Path
) -> None:
    options = f"--conditioned --start {banked_weights(tmp_path)} --validate-every 2"
    run(images, tmp_path / "a", options)
    path = tmp_path / "a" / "convbeers-xs.safetensors"
    tensors, header = read_tensors(path)
    run(images, tmp_path / "a", f"{options} --resume")
    again, again_header = read_tensors(path)
    assert header == again_header
    assert all(np.array_equal(tensor, again[name]) for name, tensor in tensors.items())
    assert [row["step"] for row in rows(tmp_path / "a" / "validation.csv")] == ["2", "4"]
    recipe = load_network(path)[1]
    assert recipe["degraded"] == "drawn over the ranges"
    assert recipe["held_out"] == ["coast_1.png"]


def test_a_run_with_the_roundings_of_int8_differs_from_one_without_and_resumes_to_the_same(
    images: Path, tmp_path: Path
) -> None:
    name = "convbeers-half-xs"
    options = f"--variant {name} --conditioned --start {name}"
    run(images, tmp_path / "plain", options)
    run(images, tmp_path / "a", f"{options} --rounding {name}-int8")
    rounded, plain = (
        weights_of(tmp_path / folder / f"{name}.safetensors") for folder in ("a", "plain")
    )
    assert not torch.equal(rounded["tail.weight"], plain["tail.weight"])
    run(images, tmp_path / "a", f"{options} --rounding {name}-int8 --resume")
    assert all(
        torch.equal(value, rounded[k])
        for k, value in weights_of(tmp_path / "a" / f"{name}.safetensors").items()
    )
    message = refused(f"train --images {images} --out {tmp_path}/a --steps 4 --resume {options}")
    assert "begun with other options: " in message
    assert "--rounding differs" in message


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--start convbeers-xs", "--conditioned and --start"),
        ("--conditioned --start convbeers-s", "the INT8 file of"),
        ("--conditioned --start none.safetensors", "no such file"),
        ("--conditioned --start convbeers-xs --variant convbeers-s", "weights of convbeers-s"),
    ],
)
def test_roundings_of_anything_but_the_start_are_refused(
    options: str, words: str, images: Path, tmp_path: Path
) -> None:
    command = f"train --images {images} --out {tmp_path}/r --steps 1"
    assert words in refused(f"{command} --rounding convbeers-xs-int8 {options}")
    assert not (tmp_path / "r").exists()


def banked_weights(folder: Path) -> Path:
    """Write the weights of a small network behind a bank, whose results depend on the sensor."""
    save_network(folder / "start.safetensors", behind_a_bank(VARIANTS["convbeers-xs"], 0.1), {})
    return folder / "start.safetensors"


def restored(path: Path, image: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    with torch.inference_mode():
        result: torch.Tensor = for_sensor(load_network(path)[0], vector)(image)
    return result


def test_a_run_at_half_resolution_starts_from_a_network_at_full_resolution(
    images: Path, tmp_path: Path
) -> None:
    start = banked_weights(tmp_path)
    options = f"--variant convbeers-half --conditioned --validate-every 2 --start {start}"
    run(images, tmp_path / "still", f"{options} --learning-rate 0 --lpips-weight 0", steps=1)
    weights = tmp_path / "still" / "convbeers-half.safetensors"
    assert load_network(weights)[1]["lpips"] == "left out: its weight is 0"
    image = torch.rand(1, 1, 26, 34, generator=torch.Generator().manual_seed(0))
    vector = torch.tensor([0.3, 0, -1, 1])
    torch.testing.assert_close(
        restored(weights, image, vector), restored(start, image, vector), rtol=0, atol=1e-5
    )
    run(images, tmp_path / "a", options, steps=2)
    assert [row["step"] for row in rows(tmp_path / "a" / "validation.csv")] == ["2"]
    first = weights_of(tmp_path / "a" / weights.name)
    run(images, tmp_path / "a", f"{options} --resume", steps=2)
    assert all(
        torch.equal(value, first[name])
        for name, value in weights_of(tmp_path / "a" / weights.name).items()
    )


def weights_of(path: Path) -> dict[str, torch.Tensor]:
    return dict(load_network(path)[0].state_dict())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--images nowhere", "no such folder"),
        ("", "Give --images, --pairs or --drawn"),
        ("--drawn 1 --variant huge", "variant"),
        ("--drawn 1 --start convbeers-xs", "holds the weights of a conditioned network"),
        ("--drawn 1 --lpips none.npz", "no such file"),
        ("--drawn 1 --device cuda", "CUDA"),
        ("--resume --drawn 1", "no such file"),
        ("--drawn 1 --learning-rate inf", "--learning-rate must be a finite number"),
        ("--drawn 1 --fft-weight inf", "--fft-weight must be a finite number"),
        ("--drawn 1 --l1-weight 0 --lpips-weight 0 --fft-weight 0", "The loss is always 0"),
        ("--drawn 1 --variant convbeers-half --patch 33", "--patch must be a multiple of 2 px"),
    ],
)
def test_wrong_options_get_one_sentence(options: str, words: str, tmp_path: Path) -> None:
    if "cuda" in options and torch.cuda.is_available():
        pytest.skip("a CUDA device is here")
    assert words in refused(f"train --out {tmp_path}/r --steps 1 {options}")


def test_pairs_bring_their_sensor_and_its_full_scale(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sensor has 14 bits, and its MTF along the track differs from that across it."""
    along = 'mtf_nyquist_along = { value = 0.05, status = "measured", source = "a test" }'
    own = own_sensor(
        tmp_path, ("bits = { value = 12", "bits = { value = 14"), ("[mtf]", f"[mtf]\n{along}")
    )
    scene = next(images.glob("*.png"))
    simulated = f"--out {tmp_path}/pairs --workers 1"
    done(f"simulate --images {scene} --sensor {own} {simulated}")
    pairs = f"--pairs {tmp_path}/pairs --out {tmp_path}/r"
    command = f"train {pairs} --variant convbeers-xs --steps 1 --batch 1 --patch 17"
    for option, name in (("--sensor", "pleiades-degraded"), ("--reference", "dior-medium")):
        message = refused(f"{command} {option} {name}")
        assert f"{option} must be the sensor that made the pairs" in message
        assert not list(tmp_path.glob("r/*"))
    stores = list[StoredPairs]()

    def kept(*values: Any, **keywords: Any) -> StoredPairs:
        stores.append(StoredPairs(*values, **keywords))
        return stores[0]

    monkeypatch.setattr(training, "StoredPairs", kept)
    done(command)
    assert load_network(tmp_path / "r" / "convbeers-xs.safetensors")[1]["degraded"] == "mine"
    assert stores[0].sensor.nominal().max_dn == 16383
    assert stores[0].symmetry == (True, False)


@pytest.mark.parametrize("more", ["--validate-every 2", "--conditioned"])
def test_a_run_that_ends_in_nan_leaves_no_weights(more: str, images: Path, tmp_path: Path) -> None:
    options = f"--variant convbeers-xs --steps 2 --batch 2 --patch 32 --learning-rate 1e30 {more}"
    message = refused(f"train --images {images} --out {tmp_path}/r {options}")
    assert "Lower the learning rate" in message
    assert "wrote" not in message
    assert not list((tmp_path / "r").glob("convbeers*"))


def test_an_earlier_run_is_not_overwritten(images: Path, finished: Path) -> None:
    options = "--variant convbeers-xs --steps 1"
    assert "--resume" in refused(f"train --images {images} --out {finished} {options}")


def test_a_larger_network_starts_where_a_smaller_one_stopped(
    images: Path, finished: Path, tmp_path: Path
) -> None:
    narrow = finished / "convbeers-xs.safetensors"
    run(images, tmp_path / "large", f"--start {narrow} --variant convbeers-s", steps=1)
    small = f"--start {tmp_path}/large/convbeers-s.safetensors --variant convbeers-xs"
    message = refused(f"train --images {images} --out {tmp_path}/small {small}")
    assert "8 blocks of 32 features" in message
    run(images, tmp_path / "again", f"--start {narrow} --learning-rate 0")
    weights = [weights_of(path) for path in (narrow, tmp_path / "again" / narrow.name)]
    assert all(torch.allclose(weights[0][name], weights[1][name]) for name in weights[0])
