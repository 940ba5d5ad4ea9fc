"""`--runtime auto`: the bytes of onnxruntime whatever is chosen, the fastest of what may be, and kept."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile

from deploy.cache import Cache
from deploy.networks import CACHE_VARIABLE, shipped_pair
from deploy.restoration import choice
from deploy.restoration.choice import Choice, Race, Setting, Trial, settled
from deploy.restoration.engine import Restorer, Strip
from deploy.restoration.options import Options, Runtime
from deploy.restoration.run import restore_file
from deploy.restoration.runtime import open_runtime
from deploy.restoration.source import Raster
from profiles.errors import OptionError
from quant.onnx_file import load_onnx
from quant.tiling.walk import Tiling

SHAPE = (1, 150, 131)
SMALL_PX = (64, 80, 112)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own for each test, and tiles that a small image has several of."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(choice, "SIDES_PX", SMALL_PX)
    monkeypatch.setattr(choice, "FLOAT_LEAST_PX", 0)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def int8() -> Path:
    return shipped_pair("convbeers-xs")[1]


def clocked(monkeypatch: pytest.MonkeyPatch, tile_s: Callable[[Setting], float]) -> list[Setting]:
    """Batches take what `tile_s` says; returns the settings that are tried, as they are."""
    tried, run = list[Setting](), Trial.run

    def timed(trial: Trial) -> None:
        run(trial)
        trial.opened_s, trial.times_s[-1] = (0.0, 0.0), (tile_s(trial.setting),) * 2
        tried.append(trial.setting)

    monkeypatch.setattr(Trial, "run", timed)
    return tried


def chosen(network: Path, shape: tuple[int, int, int] = SHAPE, **options: Any) -> Options:
    automatic = Options(network, runtime=Runtime.auto, **options)
    return settled(load_onnx(network), shape, automatic, lambda _: None)[0]


@pytest.mark.parametrize("precision", ["float", "int8"])
def test_whatever_may_be_chosen_gives_the_bytes_of_onnxruntime(
    precision: str, model: Path, int8: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = model if precision == "float" else int8
    tried = clocked(monkeypatch, lambda _: 1.0)
    pixels = np.random.default_rng(2).integers(0, 4096, SHAPE[1:]).astype(np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", pixels)
    chosen(path)
    settings = set(tried)
    assert len({each.tile_px for each in settings}) > 2
    outputs = set()
    for each in settings:
        options = Options(path, each.tile_px, runtime=each.runtime, lanes=each.lanes)
        restore_file(tmp_path / "in.tif", tmp_path / "out.tif", options, lambda _: None)
        outputs.add((tmp_path / "out.tif").read_bytes())
    assert len(outputs) == 1


def test_the_fastest_setting_is_taken_for_the_image_and_said(int8: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A tile of 80 costs as much as one of 64, and the image has fewer of them; one of 112 costs far more.
    cost_s = {640: 100.0, 64: 1.0, 80: 1.0, 112: 50.0}
    clocked(monkeypatch, lambda each: cost_s[each.tile_px])
    said = list[str]()
    network, automatic = load_onnx(int8), Options(int8, runtime=Runtime.auto)
    options, figures = settled(network, SHAPE, automatic, said.append)
    assert options.tile_px == 80
    assert options.runtime is not Runtime.auto
    assert said[0].startswith(f"runtime auto: {options.runtime}, tile 80, {options.lanes} lane")
    best, usual = figures["rate as chosen"], figures["rate as usual"]
    assert best.unit == usual.unit == "Mpx/s"
    assert (best.value or 0) > (usual.value or 0) > 0
    assert "tile 80" in best.source
    assert "onnxruntime, tile 640" in usual.source


def test_lanes_share_the_image(int8: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # With a tile of the user's the image has four: two batches of two lanes, each 1.5 times as long, are quicker.
    clocked(monkeypatch, lambda each: 1.5 if each.lanes == 2 else 1.0)
    options = chosen(int8, tile_px=96)
    assert (options.tile_px, options.lanes) == (96, 2)


def test_openvino_is_never_tried_with_floats(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = clocked(monkeypatch, lambda _: 1.0)
    assert chosen(model).runtime is Runtime.onnxruntime
    assert {each.runtime for each in tried} == {Runtime.onnxruntime}


@pytest.mark.parametrize("by", [0, 2**-20])
def test_a_runtime_that_gives_other_bits_is_not_taken_however_fast(
    by: float, int8: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choice, "_version", lambda _: "1")

    def other(runtime: Runtime, network: onnx.ModelProto, threads: int, at_once: int = 1) -> Any:
        infer, name = open_runtime(Runtime.onnxruntime, network, threads, at_once)
        return (lambda image: infer(image) + np.float32(by), name) if runtime is Runtime.openvino else (infer, name)

    monkeypatch.setattr(choice, "open_runtime", other)
    clocked(monkeypatch, lambda each: 0.01 if each.runtime is Runtime.openvino else 1.0)
    assert chosen(int8).runtime is (Runtime.onnxruntime if by else Runtime.openvino)


def test_what_the_user_chose_stays(int8: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = clocked(monkeypatch, lambda each: each.tile_px)
    assert chosen(int8, tile_px=96).tile_px == 96
    assert {each.tile_px for each in tried} == {96}
    tried.clear()
    assert chosen(int8, halo="4").tile_px == 640, "with seams the tile decides pixels"
    assert {each.tile_px for each in tried} == {640}


def test_a_budget_of_memory_allows_no_larger_tile(int8: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "TILE_PX", 80)
    tried = clocked(monkeypatch, lambda _: 1.0)
    chosen(int8, memory_bytes=1 << 40)
    assert {each.tile_px for each in tried} == {640, 64, 80}


def test_a_choice_is_kept_by_what_it_hangs_on(
    int8: Path, model: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = clocked(monkeypatch, lambda _: 1.0)

    def is_measured(network: Path, **other: Any) -> bool:
        tried.clear()
        chosen(network, **other)
        return bool(tried)

    assert is_measured(int8)
    assert not is_measured(int8)
    assert is_measured(int8, shape=(1, 151, 131))
    assert is_measured(int8, threads=1)
    assert is_measured(model)
    monkeypatch.setattr(choice, "processor_name", lambda: "another one")
    assert is_measured(int8)
    monkeypatch.setattr(choice, "_version", lambda _: None)
    assert is_measured(int8)
    assert not is_measured(int8)
    for path in cache.glob("runtime-*.json"):
        path.write_text(path.read_text().replace("lanes", "lines"))
    assert is_measured(int8), "a damaged file is measured again"


def test_a_choice_survives_the_cache(tmp_path: Path) -> None:
    one, other = Setting(Runtime.openvino, 512, 2), Setting(Runtime.onnxruntime, 640, 1)
    found = Choice(one, 12.1, other, 9.4, choice.WALL)
    Cache(tmp_path).keep("runtime", {"a": 1}, found)
    assert Cache(tmp_path).find("runtime", {"a": 1}, Choice) == found
    assert str(found) == (
        "runtime auto: openvino, tile 512, 2 lanes: measured 12.1 against 9.4 Mpx/s of onnxruntime, tile 640, 1 lane"
    )
    assert "by processor time: others used the cores too" in str(replace(found, clock=choice.PROCESSOR))


def trial(tile_px: int, times_s: list[tuple[float, float]], opened_s: tuple[float, float] = (0.0, 0.0)) -> Trial:
    """Of two batches, that is never run."""
    pixels = np.zeros((1, 8, 8), np.uint16)
    restorer = Restorer(Raster(*pixels.shape, pixels.dtype), lambda x: x, 4095.0, Tiling(0))
    return Trial(Setting(Runtime.onnxruntime, tile_px, 1), restorer, Strip(0, pixels, None), 2, opened_s, times_s)


@pytest.mark.parametrize(("wall_s", "clock"), [(1.0, choice.WALL), (9.0, choice.PROCESSOR)])
def test_where_others_use_the_cores_processor_time_decides(wall_s: float, clock: str, int8: Path) -> None:
    race = Race(load_onnx(int8), SHAPE, Options(int8, threads=1))
    trials = [
        trial(64, [(wall_s, 0.9), (wall_s, 0.9)]),
        trial(80, [(wall_s * 1.1, 0.8 if wall_s > 1 else 1.1)] * 2),
    ]
    found, by = race._compared(trials)
    assert by == clock
    assert min(found, key=lambda each: found[each]) == trials[clock == choice.PROCESSOR].setting
    assert found[trials[0].setting] == pytest.approx(2 * (wall_s if clock == choice.WALL else 0.9))


def test_what_opening_and_warming_up_take_is_counted_once() -> None:
    assert trial(64, [(5.0, 4.0), (1.0, 0.9), (1.2, 1.0)], opened_s=(10.0, 9.0)).total_s == pytest.approx(
        (16.0, 13.9)
    )
    assert trial(64, [(5.0, 4.0)], opened_s=(10.0, 9.0)).total_s == pytest.approx((20.0, 17.0))


@pytest.mark.parametrize("spread", [{"workers": 2}, {"scheduler": "tcp://127.0.0.1:1"}])
def test_workers_take_a_runtime_by_name(spread: dict[str, Any], int8: Path, tmp_path: Path) -> None:
    options = Options(int8, runtime=Runtime.auto, **spread)
    with pytest.raises(OptionError, match="one by name beside workers"):
        restore_file(tmp_path / "in.tif", tmp_path / "out.tif", options, lambda _: None)
    assert not (tmp_path / "out.tif").exists()


def test_a_network_by_name_of_its_runtime_is_not_measured(int8: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = clocked(monkeypatch, lambda _: 1.0)
    options = Options(int8)
    assert settled(load_onnx(int8), SHAPE, options, lambda _: None) == (options, {})
    assert not tried
