from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from model.convbeers import Variant
from model.patches import PatchRecipe, PatchSource, cut, turn
from model.simulator.procedural import procedural_scene
from model.simulator.scene import Scene
from model.training import MAX_BAD_STEPS, Progress, Trainer, TrainingRecipe, finish
from model.weights_file import load_network
from profiles import load_sensor
from profiles.errors import ImageError, ModelError

VARIANT = Variant(blocks=1, features=4)


def source(scene: Scene | None = None, seed: int = 0, patch_px: int = 32) -> PatchSource:
    scene = scene or procedural_scene(420, 480, np.random.default_rng(2))
    profiles = load_sensor("pleiades-variable"), load_sensor("pleiades-reference")
    return PatchSource([scene], PatchRecipe(*profiles, patch_px=patch_px), batch=3, seed=seed)


def test_the_same_seed_gives_the_same_batches_from_anywhere() -> None:
    straight, later = source().batches(), source().batches(first=18)
    batches = [next(straight) for _ in range(20)]
    for degraded, reference in batches[18:]:
        again = next(later)
        assert torch.equal(degraded, again[0])
        assert torch.equal(reference, again[1])
    assert not torch.equal(batches[0][0], next(source(seed=1).batches())[0])


def test_patches_lie_within_full_scale() -> None:
    degraded, reference = next(source().batches())
    assert degraded.shape == reference.shape == (3, 1, 32, 32)
    for image in (degraded, reference):
        assert 0 <= float(image.min()) <= float(image.max()) <= 1


def test_the_pair_shows_the_same_ground() -> None:
    degraded, reference = next(source().batches())
    for one, other in zip(degraded, reference, strict=True):
        assert np.corrcoef(one.flatten().numpy(), other.flatten().numpy())[0, 1] > 0.7


def test_scenes_too_small_for_a_patch_are_refused() -> None:
    with pytest.raises(ImageError, match="64 target pixels"):
        next(source(procedural_scene(120, 120, np.random.default_rng(0)), patch_px=64).batches())


def test_cut_takes_whole_patches_and_turn_keeps_pairs_together() -> None:
    image = torch.arange(2 * 30 * 41).reshape(2, 30, 41)
    rng = np.random.default_rng(0)
    patches = cut(image, 8, rng)
    assert patches.shape == (3 * 5 if patches.shape[0] == 15 else patches.shape[0], 2, 8, 8)
    turned = turn(patches, rng)
    assert torch.equal(turned[:, 1] - turned[:, 0], torch.full_like(turned[:, 0], 30 * 41))


def train(folder: Path, steps: int, *, resume: bool = False, kill_at: int | None = None) -> Trainer:
    """Run to the end, or until a kill that leaves the checkpoint of the step before."""

    def report(progress: Progress) -> None:
        if progress.step == kill_at:
            raise KeyboardInterrupt

    trainer = Trainer(VARIANT, TrainingRecipe(steps=steps, batch=3, warm_up_steps=2))
    checkpoint = folder / "checkpoint.safetensors"
    if resume:
        trainer.resume(checkpoint)
    trainer.run(source(), checkpoint, report, every=1, save_every_s=0.0)
    return trainer


@pytest.mark.parametrize("kill_at", [2, 5, 8])
def test_killed_and_resumed_equals_unbroken(kill_at: int, tmp_path: Path) -> None:
    unbroken = train(tmp_path / "a", 8)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "b", 8, kill_at=kill_at)
    resumed = train(tmp_path / "b", 8, resume=True)
    for name, value in unbroken.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name])
        assert torch.equal(unbroken.average[name], resumed.average[name])


def test_a_resumed_run_goes_on_where_the_killed_one_was_saved(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, 8, kill_at=5)
    later = Trainer(VARIANT, TrainingRecipe(steps=8, batch=3, warm_up_steps=2))
    later.resume(tmp_path / "checkpoint.safetensors")
    assert later.step == 4


def test_a_checkpoint_of_another_recipe_is_refused(tmp_path: Path) -> None:
    train(tmp_path, 4)
    other = Trainer(VARIANT, TrainingRecipe(steps=5))
    with pytest.raises(ModelError, match="another recipe"):
        other.resume(tmp_path / "checkpoint.safetensors")


def test_training_lowers_the_loss(tmp_path: Path) -> None:
    losses: list[float] = []
    recipe = TrainingRecipe(steps=60, batch=3, warm_up_steps=5)
    Trainer(VARIANT, recipe).run(source(), tmp_path / "c", lambda p: losses.append(p.loss), every=20)
    assert losses[-1] < 0.8 * losses[0]


class Poisoned(PatchSource):
    """A source whose batches are NaN, all or those of some numbers."""

    bad: frozenset[int] | None = None

    def batches(self, first: int = 0) -> Iterator[tuple[Tensor, Tensor]]:
        for number, (degraded, reference) in enumerate(super().batches(first), first):
            yield (degraded * float("nan") if self.bad is None or number in self.bad else degraded), reference


def poisoned(bad: frozenset[int] | None = None) -> Poisoned:
    made = Poisoned([procedural_scene(420, 480, np.random.default_rng(2))], source().recipe, 3, 0)
    made.bad = bad
    return made


def copies(trainer: Trainer) -> list[Tensor]:
    return [t.clone() for t in (*trainer.network.state_dict().values(), *trainer.average.values())]


def test_nan_batches_stop_the_run_and_touch_no_weight(tmp_path: Path) -> None:
    trainer = Trainer(VARIANT, TrainingRecipe(steps=50, batch=3))
    before = copies(trainer)
    with pytest.raises(ModelError, match=str(MAX_BAD_STEPS + 1)):
        trainer.run(poisoned(), tmp_path / "c", lambda _: None)
    assert all(torch.equal(*both) for both in zip(copies(trainer), before, strict=True))


def test_one_nan_batch_is_skipped_and_the_run_goes_on(tmp_path: Path) -> None:
    trainer, seen = Trainer(VARIANT, TrainingRecipe(steps=6, batch=3)), []
    trainer.run(poisoned(frozenset({2})), tmp_path / "c", lambda _: seen.append(copies(trainer)), every=1)
    moved = [not all(map(torch.equal, one, other)) for one, other in pairwise(seen)]
    assert moved == [True, False, True, True, True]
    assert trainer.bad_steps == 1
    again = Trainer(VARIANT, TrainingRecipe(steps=6, batch=3))
    again.resume(tmp_path / "c")
    assert again.bad_steps == 1


@pytest.mark.parametrize("level", [0.0, 80.0, 4000.0])
def test_a_constant_scene_trains_without_nan(level: float, tmp_path: Path) -> None:
    scene = Scene("flat", torch.full((420, 480), level))
    trainer = Trainer(VARIANT, TrainingRecipe(steps=4, batch=3))
    trainer.run(source(scene), tmp_path / "c", lambda _: None)
    assert trainer.bad_steps == 0
    assert all(torch.isfinite(value).all() for value in trainer.network.state_dict().values())


def test_finished_weights_carry_their_recipe(tmp_path: Path) -> None:
    trainer = train(tmp_path, 3)
    finish(trainer, tmp_path / "w.safetensors", {"loss": "L1", "steps": 3})
    network, recipe = load_network(tmp_path / "w.safetensors")
    assert recipe == {"loss": "L1", "steps": 3}
    assert network.variant == VARIANT
