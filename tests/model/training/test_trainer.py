import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from beers_deploy.model.convbeers import ConvBEERS
from beers_deploy.model.io.tensors import read_tensors
from beers_deploy.model.progress import held_back
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.checkpoint import (
    MAX_BAD_STEPS,
    WINDOW_STEPS,
    Guards,
    TrainingRecipe,
    finish,
)
from beers_deploy.model.training.source import Batch, PatchSource
from beers_deploy.model.training.trainer import Precision, Schedule, Trainer, Worker
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import ModelError, OptionError
from tests.model.networks import plain
from tests.model.training.sources import small_scene, source
from tests.project_files import ROOT

VARIANT = Variant(blocks=1, features=4)
RECIPE = TrainingRecipe(steps=8, batch=3, warm_up_steps=2)


def train(
    folder: Path,
    *,
    conditioned: bool = False,
    resume: bool = False,
    kill_at: int = 0,
) -> Trainer:
    """Train to the end, or until an interrupt that leaves the checkpoint of the step before."""

    def report(step: int, *_: object) -> None:
        if step == kill_at:
            raise KeyboardInterrupt

    trainer = Trainer(VARIANT, RECIPE, conditioned=conditioned)
    checkpoint = folder / "checkpoint.safetensors"
    if resume:
        trainer.resume(checkpoint)
    trainer.run(
        source(conditioned=conditioned).batches, checkpoint, Schedule(1, 0.0, report=report)
    )
    return trainer


def test_a_conditioned_run_changes_every_part_of_the_network(tmp_path: Path) -> None:
    before = Trainer(VARIANT, TrainingRecipe(steps=8), conditioned=True)
    after = train(tmp_path, conditioned=True)
    changed = {
        name.split(".")[0]: not torch.equal(value, after.network.state_dict()[name])
        for name, value in before.network.state_dict().items()
    }
    assert changed == dict.fromkeys(("head", "body", "body_end", "tail", "bias"), True)


@pytest.mark.parametrize("conditioned", [False, True])
def test_plain_and_conditioned_checkpoints_are_not_taken_for_one_another(
    conditioned: bool, tmp_path: Path
) -> None:
    own, other = (
        Trainer(VARIANT, RECIPE, conditioned=kind) for kind in (conditioned, not conditioned)
    )
    own.save(tmp_path / "c")
    with pytest.raises(ModelError, match="not a checkpoint of this network"):
        other.resume(tmp_path / "c")


@pytest.mark.parametrize("conditioned", [False, True])
def test_killed_and_resumed_equals_unbroken_in_every_bit(conditioned: bool, tmp_path: Path) -> None:
    unbroken = train(tmp_path / "a", conditioned=conditioned)
    saved = Trainer(VARIANT, RECIPE, conditioned=conditioned)
    for kill_at in (2, 5, 8):
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "b", conditioned=conditioned, resume=kill_at > 2, kill_at=kill_at)
        saved.resume(tmp_path / "b" / "checkpoint.safetensors")
        assert saved.step == kill_at - 1
    resumed = train(tmp_path / "b", conditioned=conditioned, resume=True)
    for trainer, folder in ((unbroken, "a"), (resumed, "b")):
        finish(trainer.averaged(), tmp_path / folder / "weights.safetensors", {"steps": 8})
    for name in ("weights.safetensors", "checkpoint.safetensors"):
        (tensors, header), (others, other_header) = (
            read_tensors(tmp_path / folder / name) for folder in "ab"
        )
        assert header == other_header
        assert tensors.keys() == others.keys()
        assert all(np.array_equal(tensor, others[name]) for name, tensor in tensors.items())


class Poisoned(PatchSource):
    """A source whose batches are NaN: all of them, or those with the numbers `bad`."""

    bad: frozenset[int] | None = None

    def batches(self, first: int = 0) -> Iterator[Batch]:
        for number, batch in enumerate(super().batches(first), first):
            bad = self.bad is None or number in self.bad
            yield batch._replace(degraded=batch.degraded * float("nan")) if bad else batch


def poisoned(bad: frozenset[int] | None = None) -> Poisoned:
    batches = Poisoned([small_scene()], source().recipe, 3, 0)
    batches.bad = bad
    return batches


def copies(trainer: Trainer) -> list[Tensor]:
    return [t.clone() for t in (*trainer.network.state_dict().values(), *trainer.average.values())]


def test_nan_batches_stop_the_run_and_touch_no_weight(tmp_path: Path) -> None:
    trainer = Trainer(VARIANT, TrainingRecipe(steps=50, batch=3))
    before = copies(trainer)
    with pytest.raises(ModelError, match=str(MAX_BAD_STEPS + 1)):
        trainer.run(poisoned().batches, tmp_path / "c", Schedule())
    assert all(torch.equal(*both) for both in zip(copies(trainer), before, strict=True))


def test_one_nan_batch_is_skipped_and_the_run_goes_on(tmp_path: Path) -> None:
    trainer = Trainer(VARIANT, TrainingRecipe(steps=6, batch=3))
    states = []
    schedule = Schedule(1, report=lambda *_: states.append(copies(trainer)))
    trainer.run(poisoned(frozenset({2})).batches, tmp_path / "c", schedule)
    changed = [not all(map(torch.equal, one, other)) for one, other in pairwise(states)]
    assert changed == [True, False, True, True, True]
    assert trainer.guards.bad_steps == 1


@pytest.mark.parametrize("level", [0.0, 80.0, 4000.0])
def test_a_constant_scene_trains_without_nan(level: float, tmp_path: Path) -> None:
    scene = Scene("flat", np.full((420, 480), level, np.float32))
    trainer = Trainer(VARIANT, TrainingRecipe(steps=4, batch=3))
    trainer.run(source(scene).batches, tmp_path / "c", Schedule())
    assert trainer.guards.bad_steps == 0
    assert all(torch.isfinite(value).all() for value in trainer.network.state_dict().values())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_finishes_the_step_and_leaves_a_checkpoint_of_it(
    number: int, tmp_path: Path
) -> None:
    def report(step: int, *_: object) -> None:
        if step == 4:
            signal.raise_signal(number)

    trainer, saved = (Trainer(VARIANT, RECIPE) for _ in range(2))
    with pytest.raises(KeyboardInterrupt):
        trainer.run(source().batches, tmp_path / "c", Schedule(1, report=report))
    saved.resume(tmp_path / "c")
    assert saved.step == trainer.step == 4
    assert all(map(torch.equal, copies(saved), copies(trainer)))


def test_a_second_ctrl_c_stops_at_once() -> None:
    def ask(times: int) -> bool:
        with held_back() as interrupt:
            for _ in range(times):
                signal.raise_signal(signal.SIGINT)
            return interrupt.asked

    # A shell that starts the tests in the background ignores SIGINT, so the handler before may not
    # be Python's own.
    before = signal.getsignal(signal.SIGINT)
    assert ask(1)
    with pytest.raises(KeyboardInterrupt):
        ask(2)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_diverging_loss_stops_the_run() -> None:
    guards = Guards()
    for step in range(WINDOW_STEPS):
        guards.passed(step, 0.01)
    for step in range(WINDOW_STEPS):
        # Four times the best loss can come from hard scenes, so the guard lets it pass.
        guards.passed(step, 0.04)
    for step in range(WINDOW_STEPS - 1):
        guards.passed(step, 0.06)
    with pytest.raises(ModelError, match="diverged"):
        guards.passed(WINDOW_STEPS, 0.06)


def test_guards_survive_a_resume(tmp_path: Path) -> None:
    trainer, resumed = (Trainer(VARIANT, TrainingRecipe(steps=8)) for _ in range(2))
    for guards in (Guards(), Guards(3, 0.01, 0.07, 7)):
        trainer.guards = guards
        trainer.save(tmp_path / "c")
        resumed.resume(tmp_path / "c")
        assert resumed.guards == guards


def test_in_float32_the_network_is_the_plain_one_and_in_bfloat16_its_body_is_rounded() -> None:
    network = ConvBEERS(VARIANT)
    image = torch.rand(2, 1, 13, 21, generator=torch.Generator().manual_seed(0))
    plain = network(image)
    rounded = network(image, bfloat16=True)
    assert not torch.equal(rounded, plain)
    assert torch.allclose(rounded, plain, atol=0.02)


@pytest.mark.parametrize("first", get_args(Precision))
def test_a_run_goes_on_in_the_other_format_and_the_loss_with_it(
    first: Precision, tmp_path: Path
) -> None:
    """A run may start on one processor and be resumed on another."""
    other: Precision = "float32" if first == "bfloat16" else "bfloat16"
    checkpoint = tmp_path / "checkpoint.safetensors"
    records = list[tuple[int, float]]()
    recipe = TrainingRecipe(steps=40, batch=3, warm_up_steps=2, learning_rate=3e-3)

    def note(step: int, terms: Mapping[str, float], *_: float) -> None:
        records.append((step, terms["l1"]))
        if len(records) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(VARIANT, recipe, precision=first).run(
            source().batches, checkpoint, Schedule(10, 0.0, report=note)
        )
    resumed = Trainer(VARIANT, recipe, precision=other)
    resumed.resume(checkpoint)
    resumed.run(source().batches, checkpoint, Schedule(10, 0.0, report=note))
    assert [step for step, _ in records[1:]] == [20, 20, 30, 40]
    assert records[-1][1] < records[0][1]


WORKER = """
import sys
from pathlib import Path
import torch
from tests.model.training.sources import source
from beers_deploy.model.training.checkpoint import TrainingRecipe
from beers_deploy.model.training.trainer import Schedule, Trainer
from beers_deploy.model.variants import Variant
from beers_deploy.model.training.trainer import joined
torch.set_num_threads(1)
with joined("cpu") as worker:
    recipe = TrainingRecipe(steps=3, batch=3, warm_up_steps=1)
    trainer = Trainer(Variant(blocks=1, features=4), recipe, worker=worker, precision="float32")
    batches = source(rank=worker.rank, workers=worker.count).batches
    trainer.run(batches, Path(sys.argv[1]), Schedule())
"""


class JointBatches:
    """A source that joins the batches of two workers."""

    def batches(self, first: int = 0) -> Iterator[Batch]:
        batches = [source(rank=rank, workers=2).batches(first) for rank in range(2)]
        for one, other in zip(*batches, strict=True):
            degraded, reference = (torch.cat(both) for both in zip(one[:2], other[:2], strict=True))
            yield Batch(degraded, reference)


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform == "win32", reason="torch for Windows lacks the libuv that torchrun asks for"
)
def test_two_workers_do_the_steps_of_one_with_a_batch_twice_as_large(tmp_path: Path) -> None:
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }
    options: dict[str, Any] = {
        "env": environment,
        "capture_output": True,
        "text": True,
        "timeout": 240,
    }
    result = subprocess.run([*command, str(script), str(tmp_path / "two")], **options)
    assert result.returncode == 0, result.stderr[-2000:]
    recipe = TrainingRecipe(steps=3, batch=3, warm_up_steps=1)
    alone, two = (Trainer(VARIANT, recipe, precision="float32") for _ in range(2))
    alone.run(JointBatches().batches, tmp_path / "one", Schedule())
    two.resume(tmp_path / "two")
    start = Trainer(VARIANT, recipe)
    for name, value in alone.network.state_dict().items():
        change = float((value - start.network.state_dict()[name]).abs().max())
        torch.testing.assert_close(two.network.state_dict()[name], value, rtol=0, atol=0.1 * change)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("conditioned", [False, True])
def test_a_recorded_step_learns_as_the_processor_does(conditioned: bool, tmp_path: Path) -> None:
    losses: dict[str, list[float]] = {}
    for device in ("cpu", "cuda"):
        values = losses.setdefault(device, [])
        trainer = Trainer(
            VARIANT, TrainingRecipe(steps=60, batch=3), device=device, conditioned=conditioned
        )
        note = Schedule(20, report=lambda _, terms, __, values=values: values.append(terms["l1"]))  # type: ignore[misc]
        # Both devices get patches drawn on the CPU, because a GPU draws other noise.
        trainer.run(source(conditioned=conditioned).batches, tmp_path / device, note)
    np.testing.assert_allclose(losses["cuda"], losses["cpu"], rtol=0.02)


def test_fine_tuning_starts_from_the_weights_given() -> None:
    first = plain(VARIANT, seed=7)
    tuned = Trainer(VARIANT, TrainingRecipe(steps=4), start=first)
    assert all(
        torch.equal(a, b)
        for a, b in zip(first.parameters(), tuned.network.parameters(), strict=True)
    )


@pytest.mark.parametrize("name", ["tpu", "mps", "meta", ""])
def test_a_device_that_training_does_not_know_is_refused(name: str) -> None:
    with pytest.raises(OptionError, match="`device` must be cpu or cuda"):
        Worker().device(name)
