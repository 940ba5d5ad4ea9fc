import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from beers_deploy.model.dataset import (
    CHUNK,
    DatasetRecipe,
    make_patches,
    plan_windows,
    processes,
    write_dataset,
)
from beers_deploy.model.manifest import DIGESTS, Line, line_text
from beers_deploy.model.progress import Step, reporting
from beers_deploy.profiles.effects import TABLES
from beers_deploy.profiles.errors import ImageError, MachineError, OptionError
from beers_deploy.profiles.scene_call import SceneCall, calling_for, origins, typical_effects
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import scene_names
from beers_deploy.restoration.cluster import open_cluster
from beers_deploy.results import Table
from beers_deploy.verbs.simulate import simulate
from tests.deploy.command_line import refused
from tests.deploy.two_workers import local_cluster


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pixels = np.random.default_rng(0).integers(0, 255, (420, 610, 3)).astype(np.uint8)
    path = tmp_path_factory.mktemp("scene") / "scene.png"
    Image.fromarray(pixels).save(path)
    return path


@pytest.fixture(scope="module")
def dataset(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the small dataset, which tests only read."""
    folder = tmp_path_factory.mktemp("made") / "all"
    write_dataset(small(scene), folder, 1, resume=False)
    return folder


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    """Copy the small dataset, for a test that damages it."""
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


VARIABLE = Sensor.load("pleiades-variable")
DEGRADED = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference")


def small(scene: Path, patch_px: int = 24) -> DatasetRecipe:
    return DatasetRecipe((scene, scene), VARIABLE, REFERENCE, oversampling=2, patch_px=patch_px)


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def resume(scene: Path, folder: Path, dataset: Path) -> None:
    """Resume a dataset, and check that it has the bytes of the undamaged one."""
    write_dataset(small(scene), folder, 1, resume=True)
    assert bytes_of(folder) == bytes_of(dataset)


@pytest.mark.slow
def test_the_bytes_do_not_depend_on_the_workers(scene: Path, dataset: Path, tmp_path: Path) -> None:
    write_dataset(small(scene), tmp_path, 2, resume=False)
    assert bytes_of(tmp_path) == bytes_of(dataset)


def test_a_process_that_ends_early_is_one_sentence() -> None:
    """As the processes of a script do that simulates without asking for its `__main__`."""
    sentence = r"A worker process ended .* `workers` 1, .*__main__"
    with pytest.raises(MachineError, match=sentence), processes(1) as pool:
        pool.submit(os._exit, 1).result()


def test_any_patch_can_be_simulated_again_alone(scene: Path, dataset: Path) -> None:
    window = plan_windows(small(scene))[7]
    (patch,) = make_patches(small(scene), [window])
    for role, dn in patch.images.items():
        np.testing.assert_array_equal(dn, tifffile.imread(dataset / role / f"{window.name}.tif"))


def test_the_manifest_records_the_origin_of_each_patch(scene: Path, dataset: Path) -> None:
    lines = [json.loads(line) for line in (dataset / "manifest.jsonl").read_text().splitlines()]
    assert len(lines) == len(plan_windows(small(scene)))
    assert [line["number"] for line in lines] == list(range(len(lines)))
    assert len({line["degraded"]["sensor"]["mtf_nyquist"] for line in lines}) == len(lines)
    for line in lines:
        for role in ("degraded", "reference"):
            dn = tifffile.imread(dataset / role / f"{line['name']}.tif")
            assert dn.shape == (24, 24)
            assert dn.dtype == np.uint16
            assert dn.max() <= 4095
        assert any(d["effect"] == "mtf" for d in line["degraded"]["plan"]["decisions"])


@pytest.mark.slow
def test_a_killed_dataset_is_resumed_to_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    options = f"--images {scene} --oversampling 2 --patch 12 --workers 1".split()
    unbroken, killed = (tmp_path / name for name in ("whole", "killed"))
    command = [sys.executable, "-m", "beers_deploy", "simulate", *options, "--out"]
    subprocess.run([*command, str(unbroken)], check=True, capture_output=True)
    with subprocess.Popen(
        [*command, str(killed)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as run:
        while not list(killed.glob("parts/*.jsonl")) and run.poll() is None:
            time.sleep(0.01)
        run.kill()
    subprocess.run([*command, str(killed), "--resume"], check=True, capture_output=True)
    assert bytes_of(killed) == bytes_of(unbroken)


def test_another_dataset_in_the_folder_is_not_overwritten(scene: Path, dataset: Path) -> None:
    before = bytes_of(dataset)
    with pytest.raises(OptionError, match="Add `resume`"):
        write_dataset(small(scene), dataset, 1, resume=False)
    with pytest.raises(OptionError, match="another dataset"):
        write_dataset(small(scene, patch_px=32), dataset, 1, resume=True)
    write_dataset(small(scene), dataset, 1, resume=True)
    assert bytes_of(dataset) == before


def flip(path: Path) -> None:
    """Flip a bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    """Truncate a file within a line."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def swap(path: Path) -> None:
    """Replace an image by another image of the dataset."""
    path.write_bytes(sorted(path.parent.iterdir())[-1].read_bytes())


def grow(path: Path) -> None:
    """Repeat the content of a file."""
    path.write_bytes(path.read_bytes() * 2)


PAIR = "degraded/0000-scene-00003.tif"
DAMAGES: dict[str, tuple[str, Callable[[Path], None], int]] = {
    "flipped": (PAIR, flip, 1),
    "cut": ("reference/0001-scene-00000.tif", cut, 1),
    "gone": (PAIR, Path.unlink, 1),
    "swapped": (PAIR, swap, 1),
    "manifest flipped": ("manifest.jsonl", flip, 1),
    "manifest cut": ("manifest.jsonl", cut, 0),
    "manifest grown": ("manifest.jsonl", grow, 0),
}
"""For each damage: the file, the damage, and the number of damaged pairs (0: not counted)."""


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_pairs_of_a_finished_dataset_are_simulated_again(
    kind: str, scene: Path, dataset: Path, copy: Path, caplog: pytest.LogCaptureFixture
) -> None:
    name, damage, count = DAMAGES[kind]
    damage(copy / name)
    with caplog.at_level(logging.WARNING, "beers_deploy"):
        resume(scene, copy, dataset)
    if count:
        assert [message.split(" ")[0] for message in caplog.messages] == [str(count)]
    assert len(caplog.messages) <= 1
    assert all("they are simulated again" in message for message in caplog.messages)


def rejected(value: object) -> Callable[[Line], None]:
    return lambda line: line["degraded"].update(rejected_snr_pairs=value)  # type: ignore[attr-defined]


FORGED: dict[str, Callable[[Line], object]] = {
    "number as a list": lambda line: line.update(number=[0]),
    "number as a float": lambda line: line.update(number=0.0),
    "many rejected": rejected(10**9),
    "rejected as text": rejected("x"),
    "no sensor": lambda line: line.update(degraded=3),
}


@pytest.mark.parametrize("kind", FORGED)
def test_a_forged_line_with_its_digest_is_simulated_again(
    kind: str, scene: Path, dataset: Path, copy: Path, caplog: pytest.LogCaptureFixture
) -> None:
    manifest = copy / "manifest.jsonl"
    lines = manifest.read_text().splitlines(keepends=True)
    line = json.loads(lines[0])
    del line[DIGESTS]
    FORGED[kind](line)
    manifest.write_text("".join([line_text(copy, line), *lines[1:]]))
    with caplog.at_level(logging.WARNING, "beers_deploy"):
        resume(scene, copy, dataset)
    assert caplog.messages[0].startswith("1 of ")


def test_only_partial_files_of_a_run_are_deleted(scene: Path, copy: Path) -> None:
    ours = [copy / "degraded" / ".a.tif.123.part", copy / ".manifest.jsonl.9.part"]
    foreign = [copy / "mine" / ".b.tif.123.part", copy / ".mine.part"]
    foreign[0].parent.mkdir()
    for path in (*ours, *foreign):
        path.touch()
    write_dataset(small(scene), copy, 1, resume=True)
    assert [path.exists() for path in (*ours, *foreign)] == [False, False, True, True]


@pytest.mark.parametrize("damage", [flip, Path.unlink])
def test_a_damaged_part_of_an_unfinished_dataset_is_simulated_again(
    damage: Callable[[Path], None], scene: Path, dataset: Path, copy: Path
) -> None:
    manifest = copy / "manifest.jsonl"
    part = copy / "parts" / "00000000.jsonl"
    part.parent.mkdir()
    part.write_text("".join(manifest.read_text().splitlines(keepends=True)[:5]))
    manifest.unlink()
    damage(part)
    resume(scene, copy, dataset)


def test_a_recipe_with_the_line_ends_of_windows_is_the_same(
    scene: Path, dataset: Path, copy: Path
) -> None:
    recipe = copy / "recipe.json"
    recipe.write_bytes(recipe.read_bytes().replace(b"\n", b"\r\n"))
    resume(scene, copy, dataset)


def test_a_scene_without_room_for_a_patch_is_refused(scene: Path) -> None:
    with pytest.raises(ImageError, match="scene pixels a side"):
        plan_windows(small(scene, patch_px=200))


def test_a_drawn_scene_without_room_asks_for_images(scene: Path) -> None:
    drawn = replace(small(scene, patch_px=1500), scenes=(None,), oversampling=5)
    with pytest.raises(ImageError, match=r"drawn scene .* 7820 .* `images`"):
        plan_windows(drawn)


def test_a_drawn_scene_needs_no_file(scene: Path) -> None:
    windows = plan_windows(replace(small(scene), scenes=(scene, None)))
    assert {window.scene for window in windows} == {0, 1}
    assert windows[-1].name.startswith("0001-drawn")


def test_every_effect_has_a_typical_value_and_every_scene_loads() -> None:
    assert [*typical_effects()] == [*TABLES]
    assert len(TABLES) == 9
    assert scene_names() == ["desert-noon", "haze-over-sea", "night-port", "snow"]
    for name in scene_names():
        call = SceneCall.load(name)
        assert set(calling_for(DEGRADED, call).effects) == set(call.effects)


HAZE = SceneCall.load("haze-over-sea")


def test_effects_are_added_and_forbidden() -> None:
    assert set(calling_for(DEGRADED, HAZE, ["prnu"], ["veil"]).effects) == {"striping", "prnu"}
    transmittance = calling_for(DEGRADED, HAZE, ["veil"]).effects["veil"]["transmittance"]
    # This is the scene's own value, not the typical one.
    assert transmittance.low == 0.6
    with pytest.raises(OptionError, match="clouds"):
        calling_for(DEGRADED, None, ["clouds"])
    for name in TABLES:
        with pytest.raises(OptionError, match=f"both adds and forbids {name} "):
            calling_for(DEGRADED, None, ["prnu", name], [name])


def test_each_effect_has_its_origin() -> None:
    base = {"mtf": "sensor pleiades-degraded", "noise": "sensor pleiades-degraded"}
    assert origins(DEGRADED, None) == base
    assert origins(DEGRADED, HAZE, ["prnu", "striping"], ["veil"]) == base | {
        "veil": "left out by `without`",
        "striping": "scene haze-over-sea",
        "prnu": "`with_`",
    }
    striped = replace(DEGRADED, effects=typical_effects())
    assert (
        origins(striped, replace(HAZE, without=("dsnu",)))["dsnu"]
        == "left out by scene haze-over-sea"
    )
    for scene, add in ((None, []), (HAZE, ["prnu"])):
        added = {name for name in origins(DEGRADED, scene, add) if name not in base}
        assert added == set(calling_for(DEGRADED, scene, add).effects)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Yield the address of a scheduler with two workers."""
    pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    with local_cluster(2) as local:
        yield str(local.scheduler_address)


@pytest.mark.slow
def test_a_scheduler_s_workers_give_the_same_bytes(
    scene: Path, scheduler: str, tmp_path: Path
) -> None:
    recipe = small(scene, patch_px=12)
    assert len(plan_windows(recipe)) > 2 * CHUNK
    write_dataset(recipe, tmp_path / "here", 1, resume=False)
    progress: list[Step] = []
    with open_cluster(scheduler) as cluster, reporting(progress.append):
        assert cluster
        write_dataset(recipe, tmp_path / "there", cluster.slots, False, cluster.pool)
    assert bytes_of(tmp_path / "there") == bytes_of(tmp_path / "here")
    assert progress[-1].done == progress[-1].total == len(plan_windows(recipe))


def test_a_scene_that_cannot_be_read_there_is_one_sentence(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="no such file"):
        make_patches(small(tmp_path / "gone.png"), plan_windows(small(scene))[:1])


def test_a_folder_of_scenes_becomes_a_dataset_and_the_table_counts_its_pairs(
    scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "d"
    table = simulate(images=scene.parent, out=out, oversampling=2, patch=64, workers=1)
    assert isinstance(table, Table)
    (row,) = table.rows
    count = len((out / "manifest.jsonl").read_text().splitlines())
    assert row.figures["pairs"].value == count > 0
    assert table.inputs == (scene,)
    assert table.title == f"wrote {out}"


def test_the_explanation_has_each_effect_with_its_origin_and_writes_nothing(
    scene: Path, working_folder: Path
) -> None:
    table = simulate(
        images=scene,
        oversampling=2,
        scene="haze-over-sea",
        with_=["prnu"],
        without=["veil"],
        explain=True,
    )
    assert isinstance(table, Table)
    words = {row.name: row.text for row in table.rows}
    assert words["prnu"]["from"] == "`with_`"
    assert words["striping"]["from"] == "scene haze-over-sea"
    assert words["mtf"]["from"] == "sensor pleiades-degraded"
    assert all(text["decision"] and text["why"] for text in words.values())
    assert list(working_folder.iterdir()) == []


def test_a_command_without_an_output_or_with_no_such_input_is_refused(working_folder: Path) -> None:
    assert "--out is missing. Give it, or add --explain" in refused("simulate")
    assert "no such file" in refused("simulate --images none --out d")
    assert list(working_folder.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"patch": 8}, "`patch` has no effect without `out`"),
        ({"preset": "paper-test"}, "`preset` has no effect without `out`"),
        ({"tolerance": 1.0}, "`tolerance` has no effect without `out`"),
        ({"oversampling": 2.5}, "`oversampling` must be an integer without `out`, got 2.5"),
        ({"images": ["a.tif", "b.tif"]}, "`images` must be one scene without `out`, got 2"),
    ],
)
def test_options_that_a_single_pair_does_not_use_are_refused(
    options: dict[str, Any], words: str
) -> None:
    with pytest.raises(OptionError, match=words):
        simulate(**options)
