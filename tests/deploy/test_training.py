"""`train` from options to a folder of results."""

import csv
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from beers_deploy.model.convbeers import load_network, save_network, told
from beers_deploy.model.io.tensors import read_tensors
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.training import run as training
from beers_deploy.model.training.run import Log
from beers_deploy.model.training.stored import StoredPairs
from beers_deploy.model.variants import VARIANTS
from tests.deploy.command_line import done, refused
from tests.model.networks import behind_a_bank
from tests.profiles.own_sensor import own_sensor

SIDE = 420


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for number, site in enumerate(("coast_1", "forest_1", "town_1")):
        radiance = procedural_scene(SIDE, SIDE, np.random.default_rng(number)).radiance
        grey = np.clip(255 * (radiance / 400) ** (1 / 2.2), 0, 255).astype(np.uint8)
        Image.fromarray(grey).save(folder / f"{site}.png")
    return folder


def run(images: Path, out: Path, *more: str, steps: int = 4) -> str:
    options = ["--variant", "convbeers-xs", "--steps", str(steps), "--batch", "2", "--patch", "32"]
    return done("train", "--images", images, "--out", out, *options, *more)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_run_leaves_logs_pictures_and_weights_that_tell_how_they_were_made(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("BEERS_LPIPS_WEIGHTS", raising=False)
    output = run(images, tmp_path / "r", "--validate-every", "2")
    assert "WITHOUT the LPIPS term" in output
    assert [row["step"] for row in rows(tmp_path / "r" / "validation.csv")] == ["2", "4"]
    assert set(rows(tmp_path / "r" / "log.csv")[0]) == {
        "step",
        "l1",
        "fft",
        "patches_per_s",
        "waited",
    }
    with Image.open(tmp_path / "r" / "validation.png") as picture:
        assert picture.width > 200
    _, recipe = load_network(tmp_path / "r" / "convbeers-xs.safetensors")
    assert recipe["lpips"] == "left out: no weights"
    assert recipe["held_out"] == ["coast_1.png"]
    assert recipe["images"] == ["forest_1.png", "town_1.png"]


def test_a_finished_run_resumes_to_the_same_weights(images: Path, tmp_path: Path) -> None:
    run(images, tmp_path / "a")
    first = load_network(tmp_path / "a" / "convbeers-xs.safetensors")[0].state_dict()
    run(images, tmp_path / "a", "--resume")
    again = load_network(tmp_path / "a" / "convbeers-xs.safetensors")[0].state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_a_run_is_not_resumed_with_other_data(images: Path, tmp_path: Path) -> None:
    """Another image, another sensor, another patch: each would end in weights that no single run
    gives.
    """
    run(images, tmp_path / "a")
    other = Path(shutil.copytree(images, tmp_path / "other"))
    image = sorted(other.glob("*.png"))[0]
    pixels = np.array(Image.open(image))
    pixels.flat[pixels.size // 2] ^= 1
    Image.fromarray(pixels).save(image)
    command = [
        "train",
        "--out",
        tmp_path / "a",
        "--variant",
        "convbeers-xs",
        "--steps",
        4,
        "--batch",
        2,
        "--resume",
    ]
    same = ["--images", images, "--patch", 32]
    for words in (
        ["--images", other, "--patch", 32],
        [*same, "--sensor", "dior-high"],
        [*same, "--drawn", 1],
    ):
        message = refused(*command, *words)
        assert "a training with other images, sensors or first weights" in message


def test_a_checkpoint_with_a_flipped_bit_is_refused(images: Path, tmp_path: Path) -> None:
    run(images, tmp_path / "a")
    path = tmp_path / "a" / "checkpoint.safetensors"
    content = path.read_bytes()
    for damaged in (
        content[:-3000] + bytes([content[-3000] ^ 1]) + content[-2999:],
        content.replace(b'"step":"4"', b'"step":"2"'),
    ):
        assert damaged != content
        path.write_bytes(damaged)
        with pytest.raises(AssertionError, match="does not match its digest"):
            run(images, tmp_path / "a", "--resume")


def test_a_conditioned_run_goes_on_from_others_and_resumes_to_the_same(
    images: Path, tmp_path: Path
) -> None:
    options = ["--conditioned", "--start", str(banked_weights(tmp_path)), "--validate-every", "2"]
    run(images, tmp_path / "a", *options)
    path = tmp_path / "a" / "convbeers-xs.safetensors"
    tensors, header = read_tensors(path)
    run(images, tmp_path / "a", *options, "--resume")
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
    options = ["--variant", name, "--conditioned", "--start", name]
    run(images, tmp_path / "plain", *options)
    run(images, tmp_path / "a", *options, "--rounding", f"{name}-int8")
    rounded, plain = (
        weights_of(tmp_path / folder / f"{name}.safetensors") for folder in ("a", "plain")
    )
    assert not torch.equal(rounded["tail.weight"], plain["tail.weight"])
    run(images, tmp_path / "a", *options, "--rounding", f"{name}-int8", "--resume")
    assert all(
        torch.equal(value, rounded[k])
        for k, value in weights_of(tmp_path / "a" / f"{name}.safetensors").items()
    )
    message = refused(
        "train", "--images", images, "--out", tmp_path / "a", *options, "--steps", 4, "--resume"
    )
    assert "another recipe" in message


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--start", "convbeers-xs"], "--conditioned and --start"),
        (["--conditioned"], "--conditioned and --start"),
        (["--conditioned", "--start", "convbeers-s"], "the INT8 file of"),
        (["--conditioned", "--start", "none.safetensors"], "no such file"),
        (
            ["--conditioned", "--start", "convbeers-xs", "--rounding", "none.onnx"],
            "no such file",
        ),
        (
            ["--conditioned", "--start", "convbeers-xs", "--variant", "convbeers-s"],
            "weights of convbeers-s",
        ),
    ],
)
def test_roundings_of_anything_but_the_start_are_refused(
    options: list[str], words: str, images: Path, tmp_path: Path
) -> None:
    command = [
        "train",
        "--images",
        images,
        "--out",
        tmp_path / "r",
        "--steps",
        1,
        "--rounding",
        "convbeers-xs-int8",
    ]
    assert words in refused(*command, *options)
    assert not (tmp_path / "r").exists()


def banked_weights(folder: Path) -> Path:
    """Of a small network behind a bank, that give something else for each sensor."""
    save_network(folder / "start.safetensors", behind_a_bank(VARIANTS["convbeers-xs"], 0.1), {})
    return folder / "start.safetensors"


def restored(path: Path, image: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    with torch.inference_mode():
        result: torch.Tensor = told(load_network(path)[0], vector)(image)
    return result


def test_a_run_at_half_resolution_starts_from_a_network_at_full_resolution(
    images: Path, tmp_path: Path
) -> None:
    start = banked_weights(tmp_path)
    options = [
        "--variant",
        "convbeers-half",
        "--conditioned",
        "--validate-every",
        "2",
        "--start",
        str(start),
    ]
    run(images, tmp_path / "still", *options, "--learning-rate", "0", steps=1)
    weights = tmp_path / "still" / "convbeers-half.safetensors"
    image = torch.rand(1, 1, 26, 34, generator=torch.Generator().manual_seed(0))
    vector = torch.tensor([0.3, 0, -1, 1])
    torch.testing.assert_close(
        restored(weights, image, vector), restored(start, image, vector), rtol=0, atol=1e-5
    )
    run(images, tmp_path / "a", *options)
    assert [row["step"] for row in rows(tmp_path / "a" / "validation.csv")] == ["2", "4"]
    first = weights_of(tmp_path / "a" / weights.name)
    run(images, tmp_path / "a", *options, "--resume")
    assert all(
        torch.equal(value, first[name])
        for name, value in weights_of(tmp_path / "a" / weights.name).items()
    )


def test_a_plain_run_takes_no_conditioned_weights(images: Path, tmp_path: Path) -> None:
    options = ["--images", str(images), "--out", str(tmp_path / "b"), "--steps", "1"]
    message = refused("train", *options, "--start", banked_weights(tmp_path))
    assert "holds the weights of a conditioned network" in message


def weights_of(path: Path) -> dict[str, torch.Tensor]:
    return dict(load_network(path)[0].state_dict())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--images", "nowhere"], "no such folder"),
        ([], "Give --images, --pairs or --drawn"),
        (["--pairs", "here", "--drawn", "1"], "--drawn has no effect with --pairs"),
        (["--pairs", "here", "--images", "there"], "--images has no effect with --pairs"),
        (["--drawn", "1", "--variant", "huge"], "variant"),
        (["--drawn", "1", "--start", "none.safetensors"], "no such file"),
        (
            ["--drawn", "1", "--start", "convbeers-xs"],
            "holds the weights of a conditioned network",
        ),
        (["--drawn", "1", "--lpips", "none.npz"], "no such file"),
        (["--drawn", "1", "--device", "cuda"], "CUDA"),
        (["--resume", "--drawn", "1"], "no such file"),
        (["--conditioned", "--pairs", "here"], "--conditioned has no effect with --pairs"),
        (["--drawn", "1", "--learning-rate", "inf"], "learning rate must be a finite number"),
        (
            ["--drawn", "1", "--fft-weight", "inf"],
            "weight of fft in the loss must be a finite number",
        ),
        (
            ["--drawn", "1", "--l1-weight", "0", "--lpips-weight", "0", "--fft-weight", "0"],
            "The loss is always 0",
        ),
        (["--pairs", "here", "--validate-every", "5"], "--validate-every has no effect without"),
        (["--drawn", "1", "--validate-every", "5"], "--validate-every has no effect without"),
        (
            ["--drawn", "1", "--variant", "convbeers-half", "--patch", "33"],
            "--patch must be a multiple of 2 px",
        ),
    ],
)
def test_wrong_options_get_one_sentence(options: list[str], words: str, tmp_path: Path) -> None:
    if "cuda" in options and torch.cuda.is_available():
        pytest.skip("a CUDA device is here")
    assert words in refused("train", "--out", tmp_path / "r", "--steps", "1", *options)


def test_pairs_bring_their_sensor_and_its_full_scale(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 14 bits, and of another MTF along the track than across it."""
    along = 'mtf_nyquist_along = { value = 0.05, status = "measured", source = "a test" }'
    own = own_sensor(
        tmp_path, ("bits = { value = 12", "bits = { value = 14"), ("[mtf]", f"[mtf]\n{along}")
    )
    scene = next(images.glob("*.png"))
    simulated = ("--out", tmp_path / "pairs", "--workers", "1")
    done("simulate", "--images", scene, "--sensor", own, *simulated)
    options = [
        "--pairs",
        str(tmp_path / "pairs"),
        "--variant",
        "convbeers-xs",
        "--steps",
        "1",
        "--batch",
        "1",
    ]
    options += ["--patch", "17", "--out", str(tmp_path / "r")]
    for contradiction in (["--sensor", "pleiades-degraded"], ["--reference", "dior-medium"]):
        message = refused("train", *options, *contradiction)
        assert f"{contradiction[0]} must be the sensor that made the pairs" in message
        assert not list(tmp_path.glob("r/*"))
    stores = list[StoredPairs]()

    def kept(*values: Any, **keywords: Any) -> StoredPairs:
        stores.append(StoredPairs(*values, **keywords))
        return stores[0]

    monkeypatch.setattr(training, "StoredPairs", kept)
    done("train", *options)
    assert load_network(tmp_path / "r" / "convbeers-xs.safetensors")[1]["degraded"] == "mine"
    assert (stores[0].max_dn, stores[0].quarters) == (16383, False)


def test_a_loss_of_nothing_but_lpips_needs_its_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("BEERS_LPIPS_WEIGHTS", raising=False)
    options = ["--drawn", "1", "--l1-weight", "0", "--fft-weight", "0", "--steps", "1"]
    message = refused("train", "--out", tmp_path / "r", *options)
    assert "except that of LPIPS, whose network was not found" in message


@pytest.mark.parametrize("validate_every", ["0", "2"])
@pytest.mark.parametrize("conditioned", [False, True])
def test_a_run_that_ends_in_nan_leaves_no_weights(
    conditioned: bool, validate_every: str, images: Path, tmp_path: Path
) -> None:
    more = [
        "--learning-rate",
        "1e30",
        "--validate-every",
        validate_every,
        *["--conditioned"] * conditioned,
    ]
    options = ["--variant", "convbeers-xs", "--steps", "2", "--batch", "2", "--patch", "32", *more]
    message = refused("train", "--images", images, "--out", tmp_path / "r", *options)
    assert "Lower the learning rate" in message
    assert "wrote" not in message
    assert not list((tmp_path / "r").glob("convbeers*"))


def test_a_run_in_the_way_is_not_overwritten(images: Path, tmp_path: Path) -> None:
    run(images, tmp_path / "a", steps=1)
    options = ["--out", str(tmp_path / "a"), "--variant", "convbeers-xs", "--steps", "1"]
    assert "--resume" in refused("train", "--images", images, *options)


def test_a_larger_network_starts_where_a_smaller_one_stopped(images: Path, tmp_path: Path) -> None:
    run(images, tmp_path / "narrow", steps=3)
    narrow = tmp_path / "narrow" / "convbeers-xs.safetensors"
    large = ["--start", str(narrow), "--variant", "convbeers-s", "--validate-every", "0"]
    run(images, tmp_path / "large", *large, steps=1)
    small = [
        "--start",
        str(tmp_path / "large" / "convbeers-s.safetensors"),
        "--variant",
        "convbeers-xs",
    ]
    assert "8 blocks of 32 features" in refused(
        "train", "--images", images, "--out", tmp_path / "small", *small
    )
    again = run(
        images,
        tmp_path / "again",
        "--start",
        str(narrow),
        "--learning-rate",
        "0",
        "--validate-every",
        "0",
    )
    assert "wrote" in again
    weights = (
        load_network(path)[0].state_dict() for path in (narrow, tmp_path / "again" / narrow.name)
    )
    assert all(torch.allclose(a, b) for a, b in zip(*(w.values() for w in weights), strict=True))


def test_a_log_forgets_what_lies_beyond_the_step_resumed_from(tmp_path: Path) -> None:
    log = Log(tmp_path / "log.csv", 0)
    for step in (100, 200, 300):
        log.write(step, {"l1": step / 1000})
    Log(tmp_path / "log.csv", 200).write(250, {"l1": 0.25})
    assert [row["step"] for row in rows(tmp_path / "log.csv")] == ["100", "200", "250"]
    Log(tmp_path / "log.csv", 0)
    assert (tmp_path / "log.csv").read_text() == ""
