"""What a run computes in: chosen by measurement, kept by a resume, overridden by the user."""

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from model.convbeers import ConvBEERS
from model.io.tensors import read_tensors, write_tensors
from model.simulator.procedural import procedural_scene
from model.training import precision as precision_module
from model.training.checkpoint import TrainingRecipe
from model.training.patches import PatchRecipe, PatchSource
from model.training.precision import MixedPrecision, Precision, choose_precision
from model.training.trainer import Progress, Schedule, Trainer
from model.training.workers import Worker
from model.variants import Variant
from profiles import load_sensor
from profiles.errors import ModelError

VARIANT = Variant(blocks=1, features=4)
CPU, GPU = torch.device("cpu"), torch.device("cuda")
FAST, NO_WORTH, EMULATED = 1.8, 0.9, 0.1
"""Speeds of bfloat16 beside float32: with units, with units that a small network cannot use, without."""


@pytest.mark.parametrize(
    ("speed", "wanted", "begun", "chosen"),
    [
        (FAST, None, None, "bfloat16"),
        (NO_WORTH, None, None, "float32"),
        (EMULATED, None, None, "float32"),
        (FAST, None, "float32", "float32"),
        (NO_WORTH, None, "bfloat16", "bfloat16"),
        (EMULATED, None, "bfloat16", "float32"),
        (EMULATED, "bfloat16", None, "bfloat16"),
        (FAST, "float32", "bfloat16", "float32"),
    ],
)
def test_the_faster_format_is_chosen_and_a_resumed_run_keeps_to_its_own(
    speed: float,
    wanted: Precision | None,
    begun: Precision | None,
    chosen: Precision,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(precision_module, "bfloat16_speed", lambda: speed)
    assert choose_precision(wanted, begun, Worker(), CPU) == chosen


def test_a_gpu_is_not_asked_and_computes_in_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision_module, "bfloat16_speed", lambda: pytest.fail("asked the processor"))
    assert choose_precision(None, None, Worker(), GPU) == "bfloat16"


def test_in_float32_the_network_is_the_plain_one_and_in_bfloat16_its_body_is_rounded() -> None:
    network, image = ConvBEERS(VARIANT), torch.rand(2, 1, 13, 21, generator=torch.Generator().manual_seed(0))
    plain = network(image)
    assert torch.equal(MixedPrecision(network, "float32")(image), plain)
    rounded = MixedPrecision(network, "bfloat16")(image)
    assert not torch.equal(rounded, plain)
    assert torch.allclose(rounded, plain, atol=0.02)


def source() -> PatchSource:
    scene = procedural_scene(420, 480, np.random.default_rng(2))
    profiles = load_sensor("pleiades-variable"), load_sensor("pleiades-reference")
    return PatchSource([scene], PatchRecipe(*profiles, patch_px=32), batch=3, seed=0)


@pytest.mark.parametrize("first", get_args(Precision))
def test_a_run_goes_on_in_the_other_format_and_the_loss_with_it(first: Precision, tmp_path: Path) -> None:
    """Begun on one processor and resumed on another; the checkpoint tells what it was computed in."""
    other: Precision = "float32" if first == "bfloat16" else "bfloat16"
    checkpoint, seen = tmp_path / "checkpoint.safetensors", list[Progress]()
    recipe = TrainingRecipe(steps=40, batch=3, warm_up_steps=2, learning_rate=3e-3)

    def note(progress: Progress) -> None:
        seen.append(progress)
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(VARIANT, recipe, precision=first).run(source(), checkpoint, Schedule(10, 0.0, report=note))
    assert read_tensors(checkpoint)[1]["precision"] == first
    resumed = Trainer(VARIANT, recipe, precision=other)
    resumed.resume(checkpoint)
    resumed.run(source(), checkpoint, Schedule(10, 0.0, report=note))
    assert [(each.step, each.precision) for each in seen[1:]] == [(20, first), (20, other), (30, other), (40, other)]
    assert seen[-1].terms["l1"] < seen[0].terms["l1"]


@pytest.mark.parametrize("stated", [None, "float16", 3])
def test_a_checkpoint_of_no_known_format_is_refused(stated: object, tmp_path: Path) -> None:
    checkpoint, recipe = tmp_path / "checkpoint.safetensors", TrainingRecipe(steps=4, batch=3)
    Trainer(VARIANT, recipe, precision="float32").save(checkpoint)
    tensors, header = read_tensors(checkpoint)
    write_tensors(checkpoint, tensors, {**header, "precision": stated})
    with pytest.raises(ModelError, match="expected a checkpoint of this network, got precision"):
        Trainer(VARIANT, recipe, precision="float32").resume(checkpoint)
