"""The detector learns, repeats itself, and its file says what the network says."""

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.detector.network import Decoding, DetectorNetwork, detector_to_onnx
from benchmarks.detector.training import (
    DetectorRecipe,
    Picture,
    drawn_picture,
    picture_of,
    train_detector,
    turned,
)

SIDE_PX = 64
NAMES = ("bright", "dark")


def squares(seed: int) -> Picture:
    """Two squares on grey, a bright one and a dark one, in the upper and the lower half."""
    generator = np.random.default_rng(seed)
    image = np.full((SIDE_PX, SIDE_PX), 0.5, np.float32)
    corners = []
    for top, value in ((0, 1.0), (32, 0.0)):
        side = int(generator.integers(8, 16))
        x, y = (int(v) for v in generator.integers(1, 31 - side, 2))
        image[top + y : top + y + side, x : x + side] = value
        corners.append([x, top + y, x + side, top + y + side])
    return picture_of(np.stack([image] * 3), np.array(corners, np.float64), np.array([0, 1]))


@pytest.fixture(scope="module")
def trained() -> tuple[DetectorNetwork, list[float]]:
    losses: list[float] = []
    recipe = DetectorRecipe(steps=60, batch=8, learning_rate=1e-2)
    return train_detector([squares(k) for k in range(16)], 2, recipe, losses.append), losses


@pytest.fixture(scope="module")
def model(trained: tuple[DetectorNetwork, list[float]]) -> onnx.ModelProto:
    return detector_to_onnx(trained[0], NAMES, SIDE_PX, {"seed": "0"})


def test_it_finds_what_it_never_saw(trained: tuple[DetectorNetwork, list[float]]) -> None:
    network, losses = trained
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
    for seed in range(100, 104):
        unseen = squares(seed)
        with torch.inference_mode():
            (boxes,) = Decoding(network)(torch.from_numpy(unseen.image)[None] / 255)
        for kind, corners in enumerate(unseen.corners):
            box = boxes[:4, boxes[4 + kind].argmax()].numpy()
            np.testing.assert_allclose(box[:2], (corners[:2] + corners[2:]) / 2, atol=3)
            np.testing.assert_allclose(box[2:], corners[2:] - corners[:2], atol=5)


def test_the_same_seed_gives_the_same_weights_and_another_gives_others() -> None:
    pictures = [squares(k) for k in range(3)]
    runs = [
        train_detector(pictures, 2, DetectorRecipe(steps=3, batch=2, seed=s)).state_dict()
        for s in (0, 0, 1)
    ]
    assert all(torch.equal(a, b) for a, b in zip(runs[0].values(), runs[1].values(), strict=True))
    assert not torch.equal(runs[0]["tail.weight"], runs[2]["tail.weight"])


@given(st.integers(0, 2**32))
def test_turning_moves_the_boxes_with_the_image(seed: int) -> None:
    picture = turned(squares(seed), np.random.default_rng(seed))
    for kind, value in enumerate((255, 0)):
        rows, columns = np.nonzero(picture.image[0] == value)
        bounds = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        np.testing.assert_array_equal(picture.corners[kind], bounds)


def test_the_file_says_what_the_network_says(
    model: onnx.ModelProto, trained: tuple[DetectorNetwork, list[float]]
) -> None:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    image = squares(7).image[None].astype(np.float32) / 255
    (result,) = session.run(["output0"], {"images": image})
    with torch.inference_mode():
        expected = Decoding(trained[0])(torch.from_numpy(image)).numpy()
    assert result.shape == (1, 4 + len(NAMES), (SIDE_PX // 4) ** 2)
    np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-3)


def test_a_drawn_picture_shows_its_objects_where_its_boxes_say() -> None:
    picture = drawn_picture(96, seed=0, number=1)
    assert picture.image.shape == (3, 96, 96)
    assert picture.image.dtype == np.uint8
    assert picture.image.max() == 255
    assert len(picture.classes) == len(picture.corners) > 0
    assert picture.corners.max() <= 96
    repeated = drawn_picture(96, seed=0, number=1)
    np.testing.assert_array_equal(repeated.image, picture.image)
