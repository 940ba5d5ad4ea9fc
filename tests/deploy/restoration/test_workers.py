"""Rows restored by workers: the bytes of one process, whatever becomes of the workers."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import psutil
import pytest
import tifffile

from deploy import cluster
from deploy.cluster import check_choice, local_cluster, open_cluster
from deploy.networks import shipped_pair
from deploy.restoration.engine import Restorer, Tile
from deploy.restoration.options import Options, Runtime
from deploy.restoration.plan import Span, plan_for
from deploy.restoration.radiometry import FullScale
from deploy.restoration.run import restore_file
from deploy.restoration.runtime import open_runtime
from deploy.restoration.source import open_source
from deploy.restoration.workers import Piece, Work, make_work, restore_piece
from profiles.errors import ImageError, MachineError, ModelError, OptionError
from quant.onnx_file import load_onnx, save_onnx
from quant.session import open_session, run
from quant.tiling.walk import tiling_of
from tests.quant.tiling.small_networks import espcn, float_unet, four_bands

pytestmark = pytest.mark.slow

pytest.importorskip("distributed", reason="the extra 'dask' is not installed")

ENTRY = "from deploy.cli import app; app()"
TILE_PX = 64


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """The address of a scheduler with two workers."""
    with local_cluster(2) as local:
        yield local.scheduler_address


@pytest.fixture
def image(tmp_path: Path) -> Path:
    tifffile.imwrite(tmp_path / "in.tif", noise(900, 260), tile=(16, 16))
    return tmp_path / "in.tif"


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).integers(1, 4096, shape).astype(np.uint16)


def silent(_: str) -> None:
    """Says nothing."""


def both(folder: Path, options: Options, scheduler: str) -> tuple[bytes, bytes]:
    """The bytes of one process, and those of two workers."""
    one, two = folder / "one.tif", folder / "two.tif"
    restore_file(folder / "in.tif", one, options, silent)
    row = restore_file(folder / "in.tif", two, replace(options, scheduler=scheduler), silent)
    assert row.text["workers"] == scheduler
    assert sorted(p.name for p in folder.iterdir()) == ["in.tif", "one.tif", "two.tif"]
    return one.read_bytes(), two.read_bytes()


@pytest.mark.parametrize("halo", ["exact", "2"])
@pytest.mark.parametrize("shape", [(61, 83), (150, 20), (1, 40), (3, 5)])
def test_two_workers_give_the_bytes_of_one_process(
    shape: tuple[int, int], halo: str, model: Path, scheduler: str, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "in.tif", noise(*shape))
    one, two = both(tmp_path, Options(model, tile_px=23, halo=halo), scheduler)
    assert two == one


@pytest.mark.parametrize("halo", ["exact", "5"])
def test_and_with_int8(halo: str, scheduler: str, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", noise(171, 97))
    one, two = both(tmp_path, Options(shipped_pair()[1], tile_px=TILE_PX, halo=halo), scheduler)
    assert two == one


def test_and_with_three_bands_and_missing_pixels(model: Path, scheduler: str, tmp_path: Path) -> None:
    pixels = noise(3, 90, 70)
    pixels[:, 20:50, 10:30] = 7
    options = Options(model, tile_px=23)
    planes: dict[str, Any] = {"photometric": "rgb", "planarconfig": "separate"}
    tifffile.imwrite(tmp_path / "in.tif", pixels, extratags=[(42113, "s", 0, "7", True)], **planes)
    one, two = both(tmp_path, options, scheduler)
    assert two == one
    floats = np.where(pixels == 7, np.nan, pixels / 2).astype(np.float32)
    tifffile.imwrite(tmp_path / "in.tif", floats, **planes)
    one, two = both(tmp_path, options, scheduler)
    assert two == one


@pytest.mark.parametrize("make", [float_unet, espcn, four_bands])
def test_and_with_users_networks(make: Callable[[], onnx.ModelProto], scheduler: str, tmp_path: Path) -> None:
    """With strides, a larger result, and several bands."""
    (tmp_path / "in").mkdir()
    save_onnx(make(), tmp_path / "network.onnx")
    bands = tiling_of(load_onnx(tmp_path / "network.onnx")).channels_in
    tifffile.imwrite(tmp_path / "in" / "in.tif", noise(bands, 91, 73), photometric="minisblack")
    one, two = both(tmp_path / "in", Options(tmp_path / "network.onnx", tile_px=48), scheduler)
    assert two == one


def test_and_on_openvino(model: Path, scheduler: str, tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    tifffile.imwrite(tmp_path / "in.tif", noise(61, 83))
    one, two = both(tmp_path, Options(model, tile_px=30, runtime=Runtime.openvino), scheduler)
    assert two == one


@pytest.mark.parametrize("int8", [False, True])
def test_the_number_of_threads_changes_no_bit(int8: bool, model: Path) -> None:
    window = np.random.default_rng(0).random((1, 1, 131, 97), dtype=np.float32)
    network = load_onnx(shipped_pair()[1] if int8 else model)
    one, *others = (run(open_session(network, threads), window) for threads in (1, 2, 3, 5))
    for other in others:
        np.testing.assert_array_equal(other, one)


def test_a_run_begun_here_is_finished_by_workers(
    image: Path, model: Path, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, out = Options(model, TILE_PX), tmp_path / "out.tif"
    restore_file(image, tmp_path / "expected.tif", options, silent)
    count, tile = iter(range(10**6)), Restorer.tile

    def stopping(self: Restorer, *rest: object) -> Tile:
        if next(count) == 40:
            raise KeyboardInterrupt
        return tile(self, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Restorer, "tile", stopping)
    with pytest.raises(KeyboardInterrupt):
        restore_file(image, out, options, silent)
    row = restore_file(image, out, replace(options, resume=True, scheduler=scheduler), silent)
    assert out.read_bytes() == (tmp_path / "expected.tif").read_bytes()
    assert row.figures["worker peak memory"].mode == "measured"


def test_what_a_worker_refuses_is_one_sentence_and_leaves_nothing(
    image: Path, model: Path, scheduler: str, tmp_path: Path
) -> None:
    options = Options(model, TILE_PX, scheduler=scheduler)
    pixels = noise(900, 260)
    pixels[-1, -1] = 60000
    tifffile.imwrite(image, pixels)
    with pytest.raises(ImageError, match=r"60000.*--full-scale"):
        restore_file(image, tmp_path / "out.tif", options, silent)
    tifffile.imwrite(image, np.zeros((90, 70), np.float32) * np.nan)
    with pytest.raises(ImageError, match="NaN"):
        restore_file(image, tmp_path / "out.tif", options, silent)
    with pytest.raises(MachineError, match="--memory"):
        restore_file(image, tmp_path / "out.tif", replace(options, memory_bytes=1000), silent)
    assert [p.name for p in tmp_path.iterdir()] == ["in.tif"]


@pytest.fixture
def work(image: Path, model: Path) -> Work:
    network = load_onnx(model)
    options = Options(model, TILE_PX)
    with open_source(image) as source:
        plan = plan_for(network, source.raster.shape, options)
    _, runtime = open_runtime(Runtime.onnxruntime, network, 1)
    return make_work(image, plan, network, runtime, options, FullScale(4095, "--full-scale"))


def in_workers(scheduler: str, work: Work) -> None:
    with open_cluster(0, scheduler) as there:
        list(there.in_order(restore_piece, there.share(work), work.plan.rows[:2], lambda: None))


def test_a_worker_that_cannot_read_the_image_says_where_to_put_it(work: Work, scheduler: str, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"gone.tif on worker .*No such file.*shared folder"):
        in_workers(scheduler, replace(work, image=tmp_path / "gone.tif"))
    tifffile.imwrite(tmp_path / "other.tif", np.zeros((900, 260), np.uint16), tile=(16, 16))
    with pytest.raises(ImageError, match="another file of that name"):
        in_workers(scheduler, replace(work, image=tmp_path / "other.tif"))


def test_a_worker_of_another_kind_is_refused(work: Work, scheduler: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MachineError, match=r"expected onnxruntime 0.1, got onnxruntime 1"):
        in_workers(scheduler, replace(work, runtime="onnxruntime 0.1"))
    with pytest.raises(ModelError, match="digest"):
        in_workers(scheduler, replace(work, network=replace(work.network, content=work.network.content[:-1])))
    monkeypatch.setattr(cluster, "versions", lambda: {**workers_here(), "torch": "9.9"})
    with pytest.raises(MachineError, match=r"expected torch 9.9, got torch \d"):
        in_workers(scheduler, work)
    monkeypatch.setattr(cluster, "__version__", "77.0")
    with pytest.raises(MachineError, match=r"beers-deploy 77.0"):
        in_workers(scheduler, work)


workers_here = cluster.versions


def by_value() -> None:
    """Workers cannot import a test: its functions are sent whole."""
    import_module("cloudpickle").register_pickle_by_value(sys.modules[__name__])


def slow_touch(folder: Path, number: int) -> int:
    (folder / str(number)).touch()
    time.sleep(0.05)
    return number


def test_only_so_many_pieces_are_under_way(scheduler: str, tmp_path: Path) -> None:
    most = 2 * cluster.PIECES_PER_SLOT  # two workers of one slot
    with open_cluster(0, scheduler) as there, closing(touching(there, tmp_path, 40)) as pieces:
        assert next(pieces) == 0
        while len(list(tmp_path.iterdir())) < most:
            time.sleep(0.05)
        time.sleep(0.5)
        assert len(list(tmp_path.iterdir())) == most
        assert list(pieces) == list(range(1, 40))
    assert len(list(tmp_path.iterdir())) == 40


def touching(there: cluster.Workers, folder: Path, count: int) -> Any:
    by_value()
    return there.in_order(slow_touch, folder, range(count), lambda: None)


def deadly(work: Work, row: Span) -> Piece:
    """Kills its worker at rows below the middle; where the file 'once' lies beside the image, for the first time."""
    once = work.image.with_name("once")
    if row.keep_start > work.plan.height_px / 2 and not (once.exists() and once.read_text()):
        if once.exists():
            once.write_text("it has happened")
        psutil.Process().kill()
    return restore_piece(work, row)


def test_a_worker_that_dies_once_changes_nothing(
    image: Path, model: Path, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_value()
    options, once = Options(model, TILE_PX), tmp_path / "once"
    restore_file(image, tmp_path / "expected.tif", options, silent)
    once.touch()
    monkeypatch.setattr("deploy.restoration.workers.restore_piece", deadly)
    restore_file(image, tmp_path / "out.tif", replace(options, scheduler=scheduler), silent)
    assert once.read_text() == "it has happened"
    assert (tmp_path / "out.tif").read_bytes() == (tmp_path / "expected.tif").read_bytes()


def test_workers_that_die_again_and_again_are_one_sentence(
    image: Path, model: Path, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_value()
    options, out = Options(model, TILE_PX), tmp_path / "out.tif"
    monkeypatch.setattr("deploy.restoration.workers.restore_piece", deadly)
    with pytest.raises(MachineError, match=r"4 that died over one piece.*--resume"):
        restore_file(image, out, replace(options, scheduler=scheduler), silent)
    assert journal(out).is_file()
    restore_file(image, out, replace(options, resume=True), silent)
    restore_file(image, tmp_path / "expected.tif", options, silent)
    assert out.read_bytes() == (tmp_path / "expected.tif").read_bytes()


def test_a_scheduler_that_goes_away_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "ANSWER_S", 1)
    local = local_cluster(1)
    with open_cluster(0, local.scheduler_address) as there, closing(touching(there, tmp_path, 400)) as pieces:
        next(pieces)
        local.close()
        with pytest.raises(MachineError, match="no connection to their scheduler"):
            list(pieces)


def test_nobody_at_the_address_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "ANSWER_S", 0.5)
    with (
        pytest.raises(MachineError, match=r"tcp://127.0.0.1:1: expected an answer"),
        open_cluster(0, "tcp://127.0.0.1:1"),
    ):
        pass


def test_a_scheduler_without_workers_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "JOIN_S", 0.5)
    with (
        local_cluster(0) as local,
        pytest.raises(MachineError, match="dask worker"),
        open_cluster(0, local.scheduler_address),
    ):
        pass


def test_a_missing_dask_is_one_sentence(
    image: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MachineError, match=r"pip install 'beers-deploy\[dask\]'"):
        restore_file(image, tmp_path / "out.tif", Options(model, TILE_PX, workers=2), silent)
    assert [p.name for p in tmp_path.iterdir()] == ["in.tif"]


@pytest.mark.parametrize("address", ["nonsense", "foo://a:1", "tcp://host", "tcp:host:1", "host:port"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(OptionError, match=r"tcp://host:8786"):
        check_choice(0, address)


def test_workers_here_and_elsewhere_do_not_go_together() -> None:
    for address in ("tcp://host:8786", "host:8786", "tls://[::1]:8786"):
        check_choice(0, address)
        with pytest.raises(OptionError, match="--workers"):
            check_choice(2, address)


# From here on the command itself, as a user starts and stops it.


def begin(image: Path, out: Path, model: Path, *more: str) -> subprocess.Popen[str]:
    arguments = ["restore", image, out, "--model", model, "--tile", TILE_PX, *more]
    command = [sys.executable, "-c", ENTRY, *map(str, arguments)]
    # a session of its own, as a terminal gives it, so that a signal can go to all its processes
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def until(running: subprocess.Popen[str], word: str) -> None:
    assert running.stdout is not None
    assert any(word in line for line in running.stdout)


def worker_processes(running: subprocess.Popen[str]) -> list[psutil.Process]:
    children = psutil.Process(running.pid).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def until_a_row_is_finished(out: Path, running: subprocess.Popen[str]) -> None:
    while not journal(out).is_file():
        assert running.poll() is None, "it ended before a row was seen"
        time.sleep(0.02)


def journal(out: Path) -> Path:
    return out.with_name(f".{out.name}.part") / "journal.json"


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """An image that takes two workers some seconds, and what one process makes of it."""
    folder = tmp_path_factory.mktemp("slow")
    tifffile.imwrite(folder / "in.tif", noise(700, 300), tile=(16, 16))
    restore_file(folder / "in.tif", folder / "out.tif", Options(shipped_pair()[1], TILE_PX), silent)
    return folder / "in.tif", (folder / "out.tif").read_bytes()


@pytest.fixture
def running(slow: tuple[Path, bytes], tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Two workers in the middle of a run into out.tif."""
    begun = begin(slow[0], tmp_path / "out.tif", shipped_pair()[1], "--workers", "2")
    try:
        until(begun, "memory")
        until_a_row_is_finished(tmp_path / "out.tif", begun)
        yield begun
    finally:
        begun.kill()
        begun.communicate()


def finish(slow: tuple[Path, bytes], out: Path) -> bytes:
    restore_file(slow[0], out, Options(shipped_pair()[1], TILE_PX, resume=True), silent)
    return out.read_bytes()


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=10)
    return not alive


def test_a_worker_killed_mid_run_changes_nothing(
    running: subprocess.Popen[str], slow: tuple[Path, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    worker_processes(running)[0].kill()
    assert not out.exists()
    said, _ = running.communicate(timeout=120)
    assert running.returncode == 0, said
    assert out.read_bytes() == slow[1]


@pytest.mark.skipif(sys.platform == "win32", reason="no other process can send Ctrl-C on Windows")
@pytest.mark.parametrize("send", ["killpg", "kill"])
def test_ctrl_c_leaves_no_process_and_a_run_to_go_on_with(
    send: str, running: subprocess.Popen[str], slow: tuple[Path, bytes], tmp_path: Path
) -> None:
    processes = psutil.Process(running.pid).children(recursive=True)
    getattr(os, send)(running.pid, signal.SIGINT)
    said, _ = running.communicate(timeout=60)
    assert running.returncode not in (0, 2)
    assert "--resume" in said
    assert "Traceback" not in said
    assert gone(processes)
    assert not (tmp_path / "out.tif").exists()
    assert finish(slow, tmp_path / "out.tif") == slow[1]


def test_a_killed_run_leaves_no_process(running: subprocess.Popen[str]) -> None:
    processes = psutil.Process(running.pid).children(recursive=True)
    assert len(worker_processes(running)) == 2
    running.kill()
    assert gone(processes)
