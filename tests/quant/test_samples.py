"""Tests that a user's own samples are read, cut and split, or refused in a sentence."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.profiles.errors import ImageError, ModelError, OptionError
from beers_deploy.quant.samples.own import OwnSamples, read_samples, samples_of
from beers_deploy.quant.samples.patches import Regenerated
from beers_deploy.quant.samples.stored import samples_in
from beers_deploy.quant.tiling.receptive_field import tiling_of
from tests.quant.quick import fix_sizes
from tests.quant.simplify.networks import parsed

SHAPE = (3, 2, 150, 137)
RAMP = np.linspace(0, 1, np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)
ONE_CHANNEL = RAMP[:, :1]
NO_REFERENCE = np.empty(0, np.float32)


def test_samples_are_cut_to_patches_of_aligned_sides(tmp_path: Path) -> None:
    """Large samples are cut to patches of 128 pixels, small ones to multiples of the alignment.

    A network of a fixed size gets every tile of its size.
    """
    large_path = stored(tmp_path / "ramp.npy", RAMP)
    samples = read_samples(large_path, 2, None, 4).all
    assert [image.shape for image in samples.degraded] == [(1, 2, 128, 128)] * 3
    assert_array_equal(samples.degraded[1][0], RAMP[1, :, :128, :128])
    small_path = stored(tmp_path / "small.npy", RAMP[:, :, :50, :37])
    small = read_samples(small_path, 2, None, 4).all
    assert small.degraded[0].shape == (1, 2, 48, 36)
    tiles = read_samples(large_path, 2, 32).all
    assert len(tiles.pairs) == 3 * 4 * 4
    # A side must be a multiple of 136 pixels, so that no patch of 128 fits the network.
    strided = read_samples(large_path, 2, None, 136).all
    assert [image.shape for image in strided.degraded] == [(1, 2, 136, 136)] * 3


def test_references_stay_with_their_images(tmp_path: Path) -> None:
    """Each image of a .npz file is paired with its own reference, here one of twice its sides."""
    images = ONE_CHANNEL[:, :, :20, :24]
    references = ONE_CHANNEL[:, :, :40, :48]
    path = stored_pair(tmp_path / "both.npz", images, references)
    pairs = read_samples(path, 1, None).all.pairs
    assert len(pairs) == len(images)
    for number, (image, reference) in enumerate(pairs):
        assert_array_equal(image[0], images[number])
        assert_array_equal(reference[0], references[number])


@pytest.mark.parametrize(("kind", "full_scale"), [(np.uint8, 255), (np.uint16, 4095)])
def test_a_folder_holds_images_and_arrays(
    kind: type[np.generic], full_scale: int, tmp_path: Path
) -> None:
    """A folder may hold image files and arrays; other files in it are ignored.

    Pixels of image files are divided by full scale. Arrays are read as they are.
    """
    numbers = np.arange(40 * 30).reshape(40, 30)
    pixels = (numbers % full_scale).astype(kind)
    array = ONE_CHANNEL[0, :, :40, :30]
    tifffile.imwrite(tmp_path / "a.tif", pixels)
    stored(tmp_path / "b.npy", array)
    (tmp_path / "notes.txt").write_text("of no matter")
    first, second = read_samples(tmp_path, 1, None).all.degraded
    assert_allclose(first[0, 0] * full_scale, pixels, atol=1e-3)
    assert_array_equal(second[0], array)


def test_every_fourth_sample_is_held_out_from_calibration(tmp_path: Path) -> None:
    """Every fourth sample is held out from calibration, so that INT8 is judged on unseen images.

    Fewer than four samples are all used for both, because none would be left to judge on.
    """
    levels = np.arange(9, dtype=np.float32) / 9
    steps = np.broadcast_to(levels[:, None, None, None], (9, 1, 8, 8)).copy()
    # Without an edge the samples would have no contrast.
    steps[..., -1] = 1
    samples = read_samples(stored(tmp_path / "nine.npy", steps), 1, None)
    unseen = [image[0, 0, 0, 0] for image in samples.unseen.degraded]
    assert [round(9 * float(level)) for level in unseen] == [3, 7]
    assert len(samples.drawn.pairs) == 7
    assert samples.drawn.digest != samples.unseen.digest
    few = OwnSamples("few", samples.samples[:3])
    assert few.drawn.digest == few.unseen.digest == few.all.digest


def test_a_tensor_that_numpy_does_not_read_is_refused() -> None:
    torch = pytest.importorskip("torch")
    with pytest.raises(ImageError, match=r"`samples` has a tensor .*BFloat16"):
        samples_in(torch.from_numpy(ONE_CHANNEL).bfloat16())


def test_samples_without_contrast_are_left_out() -> None:
    """A constant sample says nothing about a restoration: it is left out, or refused if alone."""
    flat = np.full((1, 20, 30), 0.5, np.float32)
    constant = (flat, NO_REFERENCE)
    textured = (ONE_CHANNEL[0, :, :20, :30], NO_REFERENCE)
    samples = read_samples([constant, textured], 1, None)
    assert samples.all.names == ["samples[1]"]
    with pytest.raises(ImageError, match="constant, but samples need contrast"):
        read_samples([constant], 1, None)


def array_file(array: np.ndarray) -> Callable[[Path], Path]:
    """Return a writer of an array."""
    return lambda folder: stored(folder / "x.npy", array)


def stored(path: Path, array: np.ndarray) -> Path:
    """Write an array and return its path."""
    np.save(path, array)
    return path


def with_reference(
    reference: np.ndarray, image: np.ndarray = ONE_CHANNEL[..., :8, :8]
) -> Callable[[Path], Path]:
    """Return a writer of images and references."""
    return lambda folder: stored_pair(folder / "x.npz", image, reference)


def stored_pair(path: Path, image: np.ndarray, reference: np.ndarray) -> Path:
    """Write both arrays and return the path."""
    np.savez(path, image=image, reference=reference)
    return path


def pickled(folder: Path) -> Path:
    """Write an array of Python objects, which only unpickling could read."""
    return stored(folder / "x.npy", np.array([{"a": 1}], dtype=object))


def two_arrays(folder: Path) -> Path:
    """Write a file of two arrays under names that mean nothing here."""
    path = folder / "x.npz"
    np.savez(path, first=RAMP, second=RAMP)
    return path


def cut_off(folder: Path) -> Path:
    """Write the first half of a file, as a broken download leaves it."""
    path = stored_pair(folder / "x.npz", RAMP, RAMP)
    os.truncate(path, path.stat().st_size // 2)
    return path


def folder_of(pixels: np.ndarray) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        tifffile.imwrite(folder / "x.tif", pixels)
        return folder

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (array_file(RAMP), "reads 1 channel of numbers.*has 2"),
        (array_file(ONE_CHANNEL * 3e5), "a range of 0 to .*Divide them by full scale"),
        (array_file(np.full((1, 1, 9, 9), np.nan)), "81 NaN or infinite values"),
        (array_file(RAMP[0, 0]), "a batch of"),
        (array_file(ONE_CHANNEL[..., :3, :3]), "at least 4 pixels a side, got 3 x 3"),
        (array_file(ONE_CHANNEL[:0]), "contains no sample"),
        (pickled, r"x\.npy cannot be read as samples"),
        (two_arrays, "got first, second"),
        (cut_off, r"x\.npz cannot be read as samples"),
        (with_reference(np.array(0.5)), "a reference for each image .3."),
        (
            with_reference(np.full((3, 2), "text")),
            r"The reference of x.npz\[0\] must be of real numbers",
        ),
        (
            with_reference(np.array([0.5, np.nan, np.inf])),
            r"x.npz\[1\] has 1 NaN or infinite value\.",
        ),
        (with_reference(np.zeros((3, 2)), ONE_CHANNEL[:, :, :0]), "has no pixels"),
        (lambda folder: folder / "missing.npy", "no such file"),
        (lambda folder: folder, "contains no sample"),
        (folder_of(np.array([[0, 65535]], np.uint16)), r"x\.tif must be from 0 to 4095.*to 65535"),
        (folder_of(np.array([[-7, 900]], np.int16)), "must be from 0 to 4095.*got -7 to 900"),
    ],
)
def test_invalid_samples_are_refused(
    write: Callable[[Path], Path], message: str, tmp_path: Path
) -> None:
    """Every kind of wrong input is refused with a message about its own fault, not with a
    traceback.
    """
    with pytest.raises(ImageError, match=message):
        read_samples(write(tmp_path), 1, None, 4)


def network(channels: int) -> onnx.ModelProto:
    """Return a network of one ReLU over some channels."""
    shape = f"float[N,{channels},H,W]"
    return parsed("restored = Relu(image)", f"{shape} image => {shape} restored")


def test_networks_that_simulated_patches_do_not_suit_ask_for_samples() -> None:
    """Simulated patches have one channel, so other networks need the user's own samples.

    So do networks whose fixed size no simulated patch has.
    """
    assert samples_of(network(1), None) is None
    with pytest.raises(OptionError, match="4 channels"):
        samples_of(network(4), None)
    samples = samples_of(network(4), RAMP.repeat(2, axis=1))
    assert samples is not None
    assert samples.all.degraded[0].shape == (1, 4, 128, 128)
    pooled = network(1)
    pooled.graph.node[0].op_type = "GlobalAveragePool"
    for value in (*pooled.graph.input, *pooled.graph.output):
        fix_sizes(value, 32, 32)
    with pytest.raises(OptionError, match="only images of 32 x 32 pixels"):
        samples_of(pooled, None)


def test_a_network_that_cannot_be_tiled_is_refused_for_its_operator_and_not_for_its_size() -> None:
    """Simulated patches suit it, so that `quantize` gets to name the operator."""
    scale = np.ones(1, np.float32)
    normalized = parsed(
        "y = InstanceNormalization(x, scale, bias)",
        "float[N,1,H,W] x => float[N,1,H,W] y",
        constants={"scale": scale, "bias": scale},
    )
    with pytest.raises(ModelError):
        tiling_of(normalized)
    assert samples_of(normalized, None) is None


def test_a_fault_while_a_patch_is_computed_does_not_end_a_loop() -> None:
    """An IndexError inside of a patch is raised, though a loop over indices takes it for its end.

    Otherwise a fault would pass as a shorter list of samples.
    """

    def item(number: int) -> int:
        """Return a number, and raise IndexError after the second."""
        return [0, 1][number]

    with pytest.raises(IndexError):
        list(Regenerated(item, 5))
