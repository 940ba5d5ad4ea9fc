"""What a user measures results by, and the gate that speaks of it."""

from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import beers_deploy as bd
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.gate import METRICS, parts_of, value_of
from examples.networks import build, to_onnx
from tests.quant.quick import one_guess


def measured(name: str, results: list[np.ndarray], references: list[np.ndarray]) -> float:
    return value_of([parts_of(name, *pair) for pair in zip(results, references, strict=True)])


@given(
    arrays(np.int64, (2, 5, 7), elements=st.integers(0, 3)),
    arrays(np.int64, (2, 5, 7), elements=st.integers(0, 3)),
)
def test_classes_of_pixels_are_counted_as_by_hand(predicted: np.ndarray, truth: np.ndarray) -> None:
    results = [
        np.eye(4, dtype=np.float32)[classes].transpose(2, 0, 1)[None] for classes in predicted
    ]
    references = [classes[None].astype(np.float32) for classes in truth]
    both = [
        (((predicted == k) & (truth == k)).sum(), ((predicted == k) | (truth == k)).sum())
        for k in range(4)
    ]
    assert measured("iou", results, references) == pytest.approx(
        np.mean([a / b for a, b in both if b])
    )
    assert measured("top1", results, references) == pytest.approx((predicted == truth).mean())


def test_images_are_measured_as_everywhere_else() -> None:
    generator = np.random.default_rng(0)
    results, references = ([generator.random((1, 2, 23, 31)) for _ in range(3)] for _ in range(2))
    pairs = list(zip(results, references, strict=True))
    assert measured("psnr", results, references) == pytest.approx(
        np.mean([psnr_db(*pair, 1.0) for pair in pairs])
    )
    assert measured("mae", results, references) == pytest.approx(
        np.mean([np.abs(a - b).mean() for a, b in pairs])
    )
    similarities = [ssim(a[0, k], b[0, k], 1.0) for (a, b), k in product(pairs, range(2))]
    assert measured("ssim", results, references) == pytest.approx(np.mean(similarities))


@pytest.mark.parametrize(
    ("name", "shape"), [("psnr", (1, 2, 23, 30)), ("top1", (1, 2, 23, 31)), ("iou", (1,))]
)
def test_references_of_another_kind_are_refused(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(
        OptionError, match=r"`metric`.* (references|numbers of classes as references) of 1 x "
    ):
        parts_of(name, np.zeros((1, 2, 23, 31)), np.zeros(shape))


def test_a_gate_speaks_of_classes() -> None:
    """Of a segmentation network on samples whose classes are known: what INT8 loses is limited, and
    can be broken.
    """
    network = bd.Network.load(
        to_onnx("segment", build("segment", torch.Generator().manual_seed(0)))
    )
    images = np.random.default_rng(0).random((12, 1, 32, 32), dtype=np.float32)
    classes = network(images).argmax(1)
    with one_guess():
        int8 = bd.quantize(network, samples=images[:8], progress=False)
    samples = images[8:], classes[8:]
    verdict = bd.gate(
        int8, samples=samples, metric="iou", limits={"metric_loss": 0.5, "mae": 0.1}, progress=False
    )
    figures = verdict.rows[0].figures
    assert verdict
    assert figures["iou float"].value == 1
    assert figures["iou lost"].value == pytest.approx(1 - float(figures["iou INT8"].value or 0))
    refused_verdict = bd.gate(
        int8,
        samples=(samples[0], 1 - samples[1]),
        metric="top1",
        limits={"mae": 0.1},
        progress=False,
    )
    assert refused_verdict.rows[0].figures["top1 float"].value == 0
    with pytest.raises(OptionError, match="'metric_loss' needs a `metric`"):
        bd.gate(int8, samples=samples, limits={"metric_loss": 0.1}, progress=False)
    names = ", ".join(map(repr, METRICS))
    with pytest.raises(OptionError, match=f"`metric` must be one of {names}, got 'auc'"):
        bd.gate(int8, samples=samples, metric="auc", progress=False)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="must have references for `metric`"):
        bd.gate(int8, samples=samples[0], metric="iou", progress=False)
