"""Tests of the metrics of a user's results, and of the gate that limits their loss."""

import numpy as np
import pytest
import torch
from torch import nn

import beers_deploy as bd
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.quant.gate import compare
from beers_deploy.quant.metrics import METRICS, metric_value
from beers_deploy.quant.session import open_session
from examples.networks import build, to_onnx
from tests.quant.quick import one_guess, patches_of, uniform


def test_each_metric_is_computed_as_everywhere_else() -> None:
    result, reference = np.random.default_rng(0).random((2, 1, 2, 23, 31))
    expected = {
        "psnr": psnr_db(result, reference, 1.0),
        "ssim": np.mean([ssim(result[0, k], reference[0, k], 1.0) for k in range(2)]),
        "mae": np.abs(result - reference).mean(),
    }
    for name in METRICS:
        assert metric_value(name, result, reference) == pytest.approx(expected[name])


def test_references_of_another_size_are_refused() -> None:
    with pytest.raises(OptionError, match="`metric` 'psnr' needs references of 1 x 2 x 23 x 31"):
        metric_value("psnr", np.zeros((1, 2, 23, 31)), np.zeros((1, 2, 23, 30)))


def test_a_gate_limits_the_loss_of_a_metric() -> None:
    network = bd.Network.load(to_onnx("dncnn", build("dncnn", torch.Generator().manual_seed(0))))
    images = uniform(12, 1, 32, 32)
    noise = np.random.default_rng(1).normal(0, 0.02, images.shape)
    references = np.clip(network(images) + noise, 0, 1).astype(np.float32)
    with one_guess():
        int8 = bd.quantize(network, samples=images[:8], progress=False)
    samples = images[8:], references[8:]
    limits = {"metric_loss": 0.5, "mae": 0.1, "drop_share": 1.0}
    verdict = bd.gate(int8, samples=samples, metric="ssim", limits=limits, progress=False)
    assert verdict
    figures = {name: figure.value or 0 for name, figure in verdict.rows[0].figures.items()}
    lost = figures["ssim lost"]
    assert lost > 0
    assert lost == pytest.approx(figures["ssim float"] - figures["ssim INT8"])
    limits["metric_loss"] = lost / 2
    broken = bd.gate(int8, samples=samples, metric="ssim", limits=limits, progress=False)
    assert [check.name for check in broken.failed] == ["ssim lost"]
    with pytest.raises(OptionError, match="'metric_loss' needs a `metric`"):
        bd.gate(int8, samples=samples, limits={"metric_loss": 0.1}, progress=False)
    with pytest.raises(OptionError, match=r"`metric` must be one of .*, got 'auc'"):
        bd.gate(int8, samples=samples, metric="auc", progress=False)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="must have references for `metric`"):
        bd.gate(int8, samples=samples[0], metric="ssim", progress=False)


def test_a_gate_of_classes_is_refused() -> None:
    image = uniform(1, 1, 8, 8)
    classes = nn.Sequential(nn.Conv2d(1, 3, 3), nn.AdaptiveAvgPool2d(1), nn.Flatten())
    session = open_session(bd.Network.load(classes, example=image.shape).model)
    with pytest.raises(ModelError, match=r"must be images .*, but they are 1 x 3"):
        compare(session, session, patches_of([image]))
