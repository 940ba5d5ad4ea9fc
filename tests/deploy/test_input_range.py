"""Tests of a network that reads colours and a map of noise levels, as FFDNet does."""

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import tifffile
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch import nn

import beers_deploy as bd
from beers_deploy.profiles.errors import ImageError, ModelError
from beers_deploy.quant.encodings import read_core
from beers_deploy.studies.evaluation.methods import method_of
from tests.deploy.command_line import done, refused
from tests.quant.quick import one_guess
from tests.quant.simplify.networks import parsed

TOP = 50
"""The largest noise level, in digital numbers of 8 bits."""
OPTION = f"0,1,0,1,0,1,0,{TOP}"


def network(largest: float) -> bd.Network:
    """Return a network of 3 + 1 channels, the last one of levels up to `largest`."""
    first = nn.Conv2d(16, 12, 3, padding=1)
    last = nn.Conv2d(12, 12, 3, padding=1)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for values in (*first.parameters(), *last.parameters()):
            values.normal_(0, 0.1, generator=generator)
        # The unshuffled channels of the map come last.
        first.weight[:, 12:] /= largest
    net = nn.Sequential(nn.PixelUnshuffle(2), first, nn.ReLU(), last, nn.PixelShuffle(2))
    return bd.Network.load(net, example=(1, 4, 32, 32))


def samples(largest: float, count: int = 8) -> np.ndarray:
    """Return images (N, 3 + 1, 36, 36) of blocks of colour, each with a map of one noise level."""
    generator = np.random.default_rng(2)
    blocks = generator.uniform(0, 1, (count, 3, 9, 9)).astype(np.float32)
    image = np.kron(blocks, np.ones((4, 4), np.float32))
    levels = largest * generator.uniform(0, 1, (count, 1, 1, 1)).astype(np.float32)
    level_map = np.broadcast_to(levels, image[:, :1].shape)
    return np.concatenate([image, level_map], 1)


@pytest.mark.parametrize(
    ("largest", "option"),
    [(75 / 255, None), (TOP, None), (TOP, OPTION)],
    ids=["in the usual range", "found", "stated"],
)
def test_a_map_of_noise_levels_is_a_channel_of_its_own_range(
    largest: float, option: str | None
) -> None:
    """The map's range is found in the samples or stated, and the whole tool chain accepts the
    result.

    The MAE of the gate is a share of a range, and agrees with the network's own results.
    """
    floating = network(largest)
    given = samples(largest)
    with one_guess():
        int8 = bd.quantize(floating, samples=given, input_range=option, progress=False)
    assert int8.table is not None
    notes = [note for note in int8.table.notes if note.startswith("input range: ")]
    if largest < 1:
        assert int8.input_ranges == ()
        assert notes == []
    else:
        top = TOP if option else float(given[:, 3].max())
        assert list(int8.input_ranges) == [(0, 1)] * 3 + [(0, top)]
        (note,) = notes
        assert "found in the samples" in note or option
    verdict = bd.gate(floating, int8, samples=given, max_mae=0.02, progress=False)
    with pytest.raises(ImageError, match=r"samples reach .* but .* reads values up to"):
        bd.gate(floating, int8, samples=255 * given, max_mae=0.02, progress=False)
    assert verdict
    assert bd.check(int8, tile=64)
    assert bd.bench(int8, tile=64, traditional=False)
    difference = np.abs(int8(given) - floating(given))
    assert difference.mean() == pytest.approx(verdict.comparison.result.mae, rel=0.3)


def test_the_file_reads_the_networks_own_units(tmp_path: Path) -> None:
    """The INT8 file that the command line writes reads and gives the network's own units.

    It does so in stock onnxruntime, so a user's code around the network stays as it is.
    """
    floating = network(TOP)
    given = samples(TOP)
    float_path = tmp_path / "a.onnx"
    int8_path = tmp_path / "b.onnx"
    samples_path = tmp_path / "x.npy"
    floating.save(float_path)
    np.save(samples_path, given)
    arguments = ("quantize", str(float_path), "--out", str(int8_path))
    options = ("--samples", samples_path, "--input-range", OPTION, "--effort", "fast")
    text = done(*arguments, *options)
    assert "input range: 0 to 1, 0 to 1, 0 to 1, 0 to 50" in " ".join(text.split())
    session = ort.InferenceSession(int8_path, providers=["CPUExecutionProvider"])
    result = session.run(None, {"image": given})[0]
    assert np.abs(result - floating(given)).mean() < 0.05
    assert "has no effect without --samples" in refused(*arguments, "--input-range", "0,255")


def test_restore_maps_full_scale_onto_a_stated_range() -> None:
    """`restore` maps pixels to the stated range and back, and refuses a range that was only
    found in samples.

    The largest sample is no full scale, so such a range is unknown for other images.
    """
    floating = network(TOP)
    given = samples(TOP)
    option = ((-1, 1),) * 3 + ((0, TOP),)
    with one_guess():
        stated = bd.quantize(floating, samples=given, input_range=option, progress=False)
        found = bd.quantize(floating, samples=given, progress=False)
    low, high = np.array(option, np.float32).T[:, :, None, None]
    shares = (given[0] - low) / (high - low)
    # In tiles, because the host moves the pixels of several channels first.
    how: dict[str, Any] = {"full_scale": 1, "progress": False, "force": True, "tile": 24}
    restored = bd.restore(shares, network=stated, **how)
    expected = (stated(given[:1])[0] + 1) / 2
    assert_allclose(restored, np.clip(expected, 0, 1), atol=1e-5)
    with pytest.raises(ModelError, match="Quantise it again with `input_range`"):
        bd.restore(shares, network=found, **how)


def test_evaluate_gives_the_pixels_of_restore_in_a_stated_range() -> None:
    """`evaluate` maps pixels onto the range that the network reads and back, as `restore` does."""
    weight = np.random.default_rng(0).normal(0, 0.2, (1, 1, 3, 3))
    ends = "float[N,1,H,W] x => float[N,1,H,W] y"
    floating = parsed("y = Conv<pads=[1,1,1,1]>(x, w)", ends, constants={"w": weight})
    given = np.random.default_rng(1).uniform(-1, 1, (4, 1, 32, 32)).astype(np.float32)
    with one_guess():
        int8 = bd.quantize(floating, samples=given, input_range=(-1, 1), progress=False)
    degraded, reference = map(bd.Sensor.load, ("pleiades-degraded", "pleiades-reference"))
    method = method_of("int8", int8, degraded, reference)
    pixels = np.random.default_rng(2).integers(0, 4096, (32, 32)).astype(np.uint16)
    expected = bd.restore(pixels, network=int8, sensor=degraded, force=True, progress=False)
    assert_array_equal(method.restore(pixels.astype(np.float32)), expected)


def test_image_files_are_samples_of_a_stated_range(tmp_path: Path) -> None:
    """`quantize` and `gate` map full scale of image files onto a stated range, as `restore` does.

    So their results are those of the same values as arrays. A range that was only found in samples
    states nothing about full scale, so `gate` refuses image files for it.
    """
    weight = np.random.default_rng(0).normal(0, 0.2, (3, 3, 3, 3))
    ends = "float[N,3,H,W] x => float[N,3,H,W] y"
    floating = parsed("y = Conv<pads=[1,1,1,1]>(x, w)", ends, constants={"w": weight})
    pixels = np.random.default_rng(6).integers(0, 256, (4, 32, 32, 3), np.uint8)
    pixels[:, 0, :2] = [[0], [255]]
    for number, image in enumerate(pixels):
        tifffile.imwrite(tmp_path / f"{number}.tif", image, photometric="rgb")
    values = np.moveaxis(pixels, -1, 1) / np.float32(255) * 2 - 1
    cores = []
    maes = []
    for given in (tmp_path, values):
        with one_guess():
            int8 = bd.quantize(floating, samples=given, input_range=(-1, 1), progress=False)
        cores.append(read_core(int8.model).convolutions[0])
        compared = bd.compare(floating, int8, samples=given, progress=False)
        maes.append(compared.result.mae)
    assert_array_equal(cores[0].weight, cores[1].weight)
    assert maes[0] == pytest.approx(maes[1], rel=1e-3)
    with one_guess():
        found = bd.quantize(floating, samples=values, progress=False)
    with pytest.raises(ModelError, match="Quantise it again with `input_range`"):
        bd.gate(floating, found, samples=tmp_path, progress=False)
