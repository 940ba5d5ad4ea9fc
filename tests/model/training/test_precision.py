"""What a run computes in: float32, or bfloat16 where that is asked for."""

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import pytest
import torch

from beers_deploy.model.convbeers import ConvBEERS
from beers_deploy.model.training.checkpoint import TrainingRecipe
from beers_deploy.model.training.trainer import Precision, Schedule, Trainer
from beers_deploy.model.variants import Variant
from tests.model.training.sources import source

VARIANT = Variant(blocks=1, features=4)


def test_in_float32_the_network_is_the_plain_one_and_in_bfloat16_its_body_is_rounded() -> None:
    network, image = ConvBEERS(VARIANT), torch.rand(2, 1, 13, 21, generator=torch.Generator().manual_seed(0))
    plain = network(image)
    rounded = network(image, bfloat16=True)
    assert not torch.equal(rounded, plain)
    assert torch.allclose(rounded, plain, atol=0.02)


@pytest.mark.parametrize("first", get_args(Precision))
def test_a_run_goes_on_in_the_other_format_and_the_loss_with_it(first: Precision, tmp_path: Path) -> None:
    """Begun on one processor and resumed on another."""
    other: Precision = "float32" if first == "bfloat16" else "bfloat16"
    checkpoint, seen = tmp_path / "checkpoint.safetensors", list[tuple[int, float]]()
    recipe = TrainingRecipe(steps=40, batch=3, warm_up_steps=2, learning_rate=3e-3)

    def note(step: int, terms: Mapping[str, float], _: float) -> None:
        seen.append((step, terms["l1"]))
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(VARIANT, recipe, precision=first).run(source().batches, checkpoint, Schedule(10, 0.0, report=note))
    resumed = Trainer(VARIANT, recipe, precision=other)
    resumed.resume(checkpoint)
    resumed.run(source().batches, checkpoint, Schedule(10, 0.0, report=note))
    assert [step for step, _ in seen[1:]] == [20, 20, 30, 40]
    assert seen[-1][1] < seen[0][1]
