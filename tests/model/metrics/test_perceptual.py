import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch
from safetensors.numpy import load_file, save_file
from skimage.filters import gaussian
from torch import Tensor

from beers_deploy.model.metrics.perceptual import (
    PUBLISHED,
    WEIGHTS_VARIABLE,
    Backbone,
    Dists,
    Lpips,
    find_backbone,
    not_found,
)
from beers_deploy.profiles.errors import ImageError, ModelError

Weights = dict[str, np.ndarray]
STEMS = {"squeeze": "squeezenet1_1", "vgg": "vgg16"}


def random_weights(network: str) -> Weights:
    """Return random weights that keep the size of the features from layer to layer."""
    rng = np.random.default_rng(len(network))
    weights = {}
    for name, tensor in Backbone(network).state_dict().items():
        fan_in = tensor[0].numel() if name.endswith("weight") else 200
        weights[name] = (rng.standard_normal(tuple(tensor.shape)) * np.sqrt(2 / fan_in)).astype(
            np.float32
        )
    return weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    for network, stem in STEMS.items():
        save_file(random_weights(network), folder / f"{stem}-made-up.safetensors")
    return folder


@pytest.fixture(params=[*STEMS, "dists"])
def metric(request: pytest.FixtureRequest, folder: Path) -> Lpips | Dists:
    return load(request.param, folder)


def load(name: str, folder: Path) -> Lpips | Dists:
    path = find_backbone("vgg" if name == "dists" else name, folder)
    assert path is not None
    return Dists.load(path) if name == "dists" else Lpips.load(name, path)


def pair(height: int, width: int, sigma: float = 0.1, seed: int = 0) -> tuple[Tensor, Tensor]:
    reference = skimage.data.camera()[60 : 60 + height, 200 : 200 + width] / 255
    noise = np.random.default_rng(seed).standard_normal(reference.shape) * sigma
    return as_batch(reference + noise), as_batch(reference)


def as_batch(plane: np.ndarray) -> Tensor:
    return torch.from_numpy(plane).float()[None, None]


@pytest.mark.parametrize(
    ("name", "sides", "plain"),
    [
        ("squeeze", (64, 64), 0.027601460286969574),
        ("squeeze", (67, 53), 0.023441671801072747),
        ("vgg", (37, 32), 0.01978812746668637),
        ("dists", (37, 32), 0.018686297502282345),
    ],
)
def test_agrees_with_a_plain_computation(
    name: str, sides: tuple[int, int], plain: float, folder: Path
) -> None:
    """The expected values were computed in float64, layer by layer.

    See `git show 3410fc11:tests/model/metrics/test_perceptual.py`.
    """
    images = pair(*sides)
    metric = load(name, folder)
    assert float(metric(*images)) == pytest.approx(plain, rel=1e-5)
    assert float(metric.double()(*(a.double() for a in images))) == pytest.approx(plain, rel=1e-7)


def test_identical_images_are_0_with_no_gradient(metric: Lpips | Dists) -> None:
    _, reference = pair(64, 48)
    image = reference.clone().requires_grad_()
    value = metric(image, reference)
    value.sum().backward()
    assert not any(parameter.grad is not None for parameter in metric.parameters())
    assert value.tolist() == [0.0]
    assert image.grad is not None
    assert not image.grad.any()


def test_each_pair_of_a_batch_has_its_own_value(metric: Lpips | Dists) -> None:
    pairs = [pair(40, 36, sigma) for sigma in (0.02, 0.3)]
    images, references = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    singly = [float(metric(*one)) for one in pairs]
    assert metric(images, references).tolist() == pytest.approx(singly, rel=1e-4)
    assert metric(references, images).tolist() == pytest.approx(singly, rel=1e-4)
    assert 0 < singly[0] < singly[1]


@pytest.mark.parametrize("size", [0.0, 1e-12])
def test_dead_features_keep_the_gradient_finite(size: float, metric: Lpips | Dists) -> None:
    for parameter in metric.backbone.parameters():
        parameter.data.mul_(size)
    image, reference = pair(40, 40)
    image.requires_grad_()
    value = metric(image, reference)
    value.sum().backward()
    assert image.grad is not None
    assert image.grad.isfinite().all()
    assert value.isfinite().all()


@pytest.mark.parametrize("name", STEMS)
def test_only_the_direction_of_features_counts(name: str, folder: Path) -> None:
    """Features a thousand times smaller give the same distance: each pixel's are normalised."""
    metric = load(name, folder)
    for key, parameter in metric.backbone.named_parameters():
        if key.endswith("bias"):
            parameter.data.zero_()
    images = pair(40, 40)
    distance = float(metric(*images))
    first = next(metric.backbone.parameters())
    first.data.mul_(1e-3)
    assert float(metric(*images)) == pytest.approx(distance, rel=1e-3)


@pytest.mark.parametrize(("network", "smallest"), [("squeeze", 17), ("vgg", 16), ("dists", 16)])
def test_the_smallest_image(network: str, smallest: int, folder: Path) -> None:
    metric = load(network, folder)
    assert metric(*pair(smallest, smallest)).isfinite().all()
    with pytest.raises(ImageError, match=f"at least {smallest} pixels a side"):
        metric(*pair(smallest - 1, smallest))


def test_images_of_different_shapes_are_refused(metric: Lpips | Dists) -> None:
    image, reference = pair(40, 40)
    colour = image.expand(-1, 3, -1, -1)
    for wrong in ((image[0], image[0]), (image[..., 1:], reference), (colour, colour)):
        with pytest.raises(ImageError, match="of one shape"):
            metric(*wrong)


@pytest.mark.parametrize(
    ("file", "total"),
    [("lpips-squeeze", 173.4387), ("lpips-vgg", 131.8555), ("dists", 1.0)],
)
def test_published_weights_are_complete(file: str, total: float) -> None:
    tensors = load_file(PUBLISHED / f"{file}.safetensors").values()
    assert all(tensor.min() >= 0 for tensor in tensors)
    assert sum(float(tensor.sum()) for tensor in tensors) == pytest.approx(total, rel=1e-5)
    assert f"`{file}.safetensors`" in (PUBLISHED / "README.md").read_text()


# The tests below read weight files that a user brings.


class Bomb:
    """An object that creates a folder when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., None], tuple[str]]:
        return os.mkdir, (str(self.trace),)


def test_npz_loads_like_safetensors_at_half_precision_and_with_other_entries(
    tmp_path: Path, folder: Path
) -> None:
    halves = {name: array.astype(np.float16) for name, array in random_weights("squeeze").items()}
    np.savez(tmp_path / "mine.npz", **halves, **{"classifier.1.weight": np.zeros(3)})  # type: ignore[arg-type]
    images = pair(40, 40)
    mine = Lpips.load("squeeze", tmp_path / "mine.npz")
    assert mine.heads.dtype == torch.float32
    assert float(mine(*images)) == pytest.approx(float(load("squeeze", folder)(*images)), rel=3e-3)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features.3.squeeze.bias": None}, "no tensor named features.3.squeeze.bias"),
        ({"features.0.weight": np.zeros((64, 3, 7, 7))}, r"\(64, 3, 3, 3\), got \(64, 3, 7"),
        ({"features.0.bias": np.full(64, 1e300)}, "infinity in features.0.bias"),
        ({"features.0.bias": np.zeros(64, np.int8)}, "floating-point numbers"),
    ],
)
def test_a_file_that_is_not_that_network_is_refused(
    tmp_path: Path, suffix: str, change: dict[str, np.ndarray | None], message: str
) -> None:
    arrays = {name: a for name, a in (random_weights("squeeze") | change).items() if a is not None}
    path = tmp_path / f"weights{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays)  # type: ignore[arg-type]
    else:
        save_file(arrays, path)
    with pytest.raises(ModelError, match=message):
        Lpips.load("squeeze", path)


def test_a_pickle_inside_npz_is_refused_and_never_run(tmp_path: Path) -> None:
    arrays: dict[str, np.ndarray] = dict(random_weights("squeeze"))
    arrays["features.0.bias"] = np.array([Bomb(tmp_path / "trace")], dtype=object)
    np.savez(tmp_path / "weights.npz", **arrays)  # type: ignore[arg-type]
    with (tmp_path / "bare.npz").open("wb") as file:
        np.save(file, arrays["features.0.bias"])
    for name in ("weights.npz", "bare.npz"):
        with pytest.raises(ModelError, match="none pickled"):
            Lpips.load("squeeze", tmp_path / name)
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("name", ["vgg16-397923af.pth", "vgg16.pt"])
def test_a_pickled_file_is_refused_with_the_way_out(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(ModelError, match=r"If you trust it, convert it: .*save_file") as error:
        Dists.load(tmp_path / name)
    assert "\n" not in str(error.value)


def test_where_a_backbone_is_searched(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    assert find_backbone("squeeze") is None
    assert find_backbone("squeeze", tmp_path) is None
    assert find_backbone("squeeze", tmp_path / "mine.npz") == tmp_path / "mine.npz"
    file = folder / "vgg16-made-up.safetensors"
    for place in (folder, file):
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(place))
        assert find_backbone("vgg") == file
        assert find_backbone("vgg", tmp_path) is None
    # The environment variable names the file of VGG16, not that of SqueezeNet.
    assert find_backbone("squeeze") is None
    assert "squeezenet1_1*.safetensors or squeezenet1_1*.npz" in not_found("squeeze")


# The tests below need the real SqueezeNet next to the repository.


@pytest.fixture(scope="module")
def squeeze(shared_data: Path) -> Lpips:
    path = find_backbone("squeeze", shared_data / "lpips")
    if path is None:
        pytest.skip(not_found("squeeze"))
    return Lpips.load("squeeze", path)


def test_known_values_on_a_photograph(squeeze: Lpips) -> None:
    """The values were computed with the `lpips` package, whose noise was another draw."""
    reference = skimage.data.camera()[:256, :256] / 255
    noise = np.random.default_rng(0).standard_normal(reference.shape)
    for sigma, published in ((0.01, 0.094), (0.05, 0.369), (0.2, 0.649)):
        noisy = np.clip(reference + sigma * noise, 0, 1)
        assert float(squeeze(as_batch(noisy), as_batch(reference))) == pytest.approx(
            published, rel=0.01
        )
    for sigma_px, published in ((0.5, 0.020), (1, 0.132), (2, 0.293), (4, 0.425)):
        blurred = gaussian(reference, sigma_px, mode="reflect")
        assert float(squeeze(as_batch(blurred), as_batch(reference))) == pytest.approx(
            published, abs=5.1e-4
        )
