"""A user's own samples: read as the network takes them, cut, split, or refused in a sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import tifffile
from onnx import TensorProto, helper

from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.quant.onnx_file import GraphWriter, image_info, make_model
from beers_deploy.quant.samples.own import OwnSamples, read_samples, samples_of
from beers_deploy.quant.samples.patches import Regenerated

RAMP = np.linspace(0, 1, 3 * 2 * 150 * 137, dtype=np.float32).reshape(3, 2, 150, 137)


def test_large_samples_are_cut_to_patches_on_the_lattice(tmp_path: Path) -> None:
    np.save(tmp_path / "ramp.npy", RAMP)
    samples = read_samples(tmp_path / "ramp.npy", 2, None, 4).all
    assert [image.shape for image in samples.degraded] == [(1, 2, 128, 128)] * 3
    np.testing.assert_array_equal(samples.degraded[1][0], RAMP[1, :, :128, :128])
    np.save(tmp_path / "small.npy", RAMP[:, :, :50, :37])
    small = read_samples(tmp_path / "small.npy", 2, None, 4).all
    assert small.degraded[0].shape == (1, 2, 48, 36)
    assert len(read_samples(tmp_path / "ramp.npy", 2, 32).all.pairs) == 3 * 4 * 4


def test_references_stay_with_their_images(tmp_path: Path) -> None:
    np.savez(tmp_path / "both.npz", image=RAMP[:, :1, :20, :24], reference=RAMP[:, :1, :40, :48])
    for (image, reference), ramp in zip(
        read_samples(tmp_path / "both.npz", 1, None).all.pairs, RAMP, strict=True
    ):
        np.testing.assert_array_equal(image[0], ramp[:1, :20, :24])
        np.testing.assert_array_equal(reference[0], ramp[:1, :40, :48])


@pytest.mark.parametrize(("kind", "full_scale"), [(np.uint8, 255), (np.uint16, 4095)])
def test_a_folder_holds_images_and_arrays(
    kind: type[np.generic], full_scale: int, tmp_path: Path
) -> None:
    pixels = (np.arange(40 * 30).reshape(40, 30) % full_scale).astype(kind)
    tifffile.imwrite(tmp_path / "a.tif", pixels)
    np.save(tmp_path / "b.npy", RAMP[0, :1, :40, :30])
    (tmp_path / "notes.txt").write_text("of no matter")
    first, second = read_samples(tmp_path, 1, None).all.degraded
    np.testing.assert_allclose(first[0, 0] * full_scale, pixels, atol=1e-3)
    np.testing.assert_array_equal(second[0], RAMP[0, :1, :40, :30])


def test_every_fourth_sample_is_kept_from_calibration(tmp_path: Path) -> None:
    steps = np.arange(9, dtype=np.float32).reshape(9, 1, 1, 1).repeat(8, 2).repeat(8, 3) / 9
    steps[..., -1] = 1
    np.save(tmp_path / "nine.npy", steps)
    samples = read_samples(tmp_path / "nine.npy", 1, None)
    assert [round(9 * float(image[0, 0, 0, 0])) for image in samples.unseen.degraded] == [3, 7]
    assert len(samples.drawn.pairs) == 7
    assert samples.drawn.digest != samples.unseen.digest
    few = OwnSamples("few", samples.samples[:3])
    assert few.drawn.digest == few.unseen.digest == few.all.digest


def test_samples_without_contrast_are_left_out() -> None:
    flat = np.full((1, 20, 30), 0.5, np.float32)
    nothing = np.empty(0, np.float32)
    textured = RAMP[0, :1, :20, :30]
    samples = read_samples([(flat, nothing), (textured, nothing)], 1, None)
    assert samples.all.names == ["samples[1]"]
    with pytest.raises(ImageError, match="constant"):
        read_samples([(flat, nothing)], 1, None)


def of(array: np.ndarray) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        np.save(folder / "x.npy", array)
        return folder / "x.npy"

    return write


def pickled(folder: Path) -> Path:
    np.save(folder / "x.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return folder / "x.npy"


def two_arrays(folder: Path) -> Path:
    np.savez(folder / "x.npz", first=RAMP, second=RAMP)
    return folder / "x.npz"


def cut_off(folder: Path) -> Path:
    np.savez(folder / "x.npz", image=RAMP)
    content = (folder / "x.npz").read_bytes()
    (folder / "x.npz").write_bytes(content[: len(content) // 2])
    return folder / "x.npz"


def with_reference(
    reference: np.ndarray, image: np.ndarray = RAMP[:, :1, :8, :8]
) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        np.savez(folder / "x.npz", image=image, reference=reference)
        return folder / "x.npz"

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (of(RAMP), "must have 1 channels of numbers.*got 2"),
        (of(RAMP[:, :1] * 3e5), "a range of 0 to .*Divide them by full scale"),
        (of(np.full((1, 1, 9, 9), np.nan)), "81 values that are NaN or infinite"),
        (of(RAMP[0, 0]), "a batch of"),
        (of(RAMP[:, :1, :3, :3]), "at least 4 pixels a side, got 3 x 3"),
        (of(RAMP[:0, :1]), "contains no sample"),
        (of(RAMP[:, :1].astype(np.complex64)), "numbers"),
        (pickled, "a .npy or .npz file of numbers, or a folder.*x\\.npy"),
        (two_arrays, "got first, second"),
        (cut_off, "a .npy or .npz file of numbers"),
        (with_reference(np.array(0.5)), "a reference for each of its 3 images"),
        (
            with_reference(np.full((3, 2), "text")),
            r"The reference of x.npz\[0\] must be of real numbers",
        ),
        (with_reference(np.zeros((3, 2), np.complex64)), "got complex64"),
        (
            with_reference(np.array([0.5, np.nan, np.inf])),
            r"x.npz\[1\] has 1 values that are NaN or infinite",
        ),
        (with_reference(np.zeros((3, 2)), RAMP[:, :1, :0]), "has no pixels"),
        (lambda folder: folder / "missing.npy", "no such file"),
        (lambda folder: folder, "contains no sample"),
    ],
)
def test_what_are_no_samples_is_refused(
    write: Callable[[Path], Path], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ImageError, match=message):
        read_samples(write(tmp_path), 1, None, 4)


def network(channels: int) -> onnx.ModelProto:
    writer = GraphWriter()
    writer.node("Relu", "restored", ["image"])
    ends = [image_info("image", channels, None)], [image_info("restored", channels, None)]
    return make_model(writer.graph("none", *ends), {})


def test_networks_that_simulated_patches_do_not_suit_ask_for_samples() -> None:
    assert samples_of(network(1), None) is None
    with pytest.raises(OptionError, match="4 channels"):
        samples_of(network(4), None)
    samples = samples_of(network(4), np.concatenate([RAMP, RAMP], 1))
    assert samples is not None
    assert samples.all.degraded[0].shape == (1, 4, 128, 128)
    pooled = network(1)
    pooled.graph.node[0].op_type = "GlobalAveragePool"
    for value in (*pooled.graph.input, *pooled.graph.output):
        value.CopyFrom(
            helper.make_tensor_value_info(value.name, TensorProto.FLOAT, ["N", 1, 32, 32])
        )
    with pytest.raises(OptionError, match="only images of 32 x 32 pixels"):
        samples_of(pooled, None)


def test_a_fault_while_a_patch_is_computed_does_not_end_a_loop() -> None:
    def item(number: int) -> int:
        return [0, 1][number]

    with pytest.raises(IndexError):
        list(Regenerated(item, 5))
