"""Tests that workers of a Dask scheduler give the bytes of a run without them, even if some die."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import onnx
import pytest
import tifffile

from beers_deploy.model.progress import Step
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import MachineError
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.restoration import cluster
from beers_deploy.restoration.cluster import open_cluster
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import PLANES, names, noise, stopped_after
from tests.deploy.two_workers import local_cluster
from tests.quant.tiling.small_networks import espcn, four_bands
from tests.shipped import shipped_pair

pytestmark = pytest.mark.slow

pytest.importorskip("distributed", reason="the extra 'dask' is not installed")

TILE_PX = 64


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    with local_cluster() as workers:
        yield workers


@pytest.fixture
def scheduler(local: Any) -> str:
    return str(local.scheduler_address)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    tifffile.imwrite(tmp_path / "in.tif", noise(900, 260), tile=(16, 16))
    return tmp_path / "in.tif"


def both(folder: Path, scheduler: str, **options: Any) -> tuple[bytes, bytes]:
    """Return the bytes that one process writes, and those with two workers."""
    one = folder / "one.tif"
    two = folder / "two.tif"
    restore(folder / "in.tif", one, **options)
    (row,) = restore(folder / "in.tif", two, scheduler=scheduler, **options)
    assert row.text["workers"] == scheduler
    assert names(folder) == ["in.tif", "one.tif", "two.tif"]
    return one.read_bytes(), two.read_bytes()


@pytest.mark.parametrize(
    ("shape", "halo"), [((61, 83), "exact"), ((150, 20), "2"), ((3, 5), "exact")]
)
def test_two_workers_give_the_bytes_of_one_process(
    shape: tuple[int, int], halo: str, model: Path, scheduler: str, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "in.tif", noise(*shape))
    one, two = both(tmp_path, scheduler, network=model, tile=23, halo=halo)
    assert two == one


def test_two_workers_restore_each_band_for_its_own_sensor(scheduler: str, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", noise(2, 91, 73), **PLANES)
    sensors = f"a={SENSOR},b={BLIND}"
    one, two = both(tmp_path, scheduler, network="convbeers-xs-int8", tile=48, sensor=sensors)
    assert two == one


@pytest.mark.parametrize("make", [lambda: load_onnx(shipped_pair()[1]), espcn, four_bands])
def test_two_workers_run_int8_and_the_networks_of_users(
    make: Callable[[], onnx.ModelProto], scheduler: str, tmp_path: Path
) -> None:
    """The networks of users have a larger result, or several bands."""
    (tmp_path / "in").mkdir()
    save_onnx(make(), tmp_path / "network.onnx")
    bands = tiling_of(load_onnx(tmp_path / "network.onnx")).channels_in
    pixels = noise(bands, 171, 97)
    tifffile.imwrite(tmp_path / "in" / "in.tif", pixels, **(PLANES if bands > 1 else {}))
    one, two = both(tmp_path / "in", scheduler, network=tmp_path / "network.onnx", tile=48)
    assert two == one


def test_workers_resume_a_run_that_began_without_them(
    image: Path, model: Path, scheduler: str, tmp_path: Path
) -> None:
    run = partial(restore, network=model, tile=TILE_PX)
    out = tmp_path / "out.tif"
    run(image, tmp_path / "expected.tif")
    with stopped_after(40):
        run(image, out)
    run(image, out, resume=True, scheduler=scheduler)
    assert out.read_bytes() == (tmp_path / "expected.tif").read_bytes()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_a_worker_that_is_killed_changes_nothing(
    image: Path, model: Path, local: Any, scheduler: str, tmp_path: Path
) -> None:
    run = partial(restore, network=model, tile=TILE_PX)
    killed: list[int] = []
    run(image, tmp_path / "expected.tif")

    def kill(_: Step) -> None:
        if not killed:
            killed.append(local.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    run(image, tmp_path / "out.tif", scheduler=scheduler, progress=kill)
    assert killed
    assert (tmp_path / "out.tif").read_bytes() == (tmp_path / "expected.tif").read_bytes()


def call(
    scheduler: str,
    function: Callable[..., object],
    *arguments: object,
    meanwhile: Callable[[], object] = tuple,
) -> None:
    """Start a call on a cluster, do something else, and wait for the result of the call."""
    with open_cluster(scheduler) as client:
        assert client
        running = client.pool.submit(function, *arguments)
        meanwhile()
        client.result(running)


def test_a_call_that_kills_its_workers_is_one_sentence() -> None:
    """The call has its own workers, because the others would take long to start again."""
    with local_cluster(1) as local:
        with pytest.raises(MachineError, match=r"died during the same call.*resume"):
            call(local.scheduler_address, os._exit, 1)
        # Dask fails to close a worker that it is about to start again.
        local.wait_for_workers(1, timeout=60)


@pytest.mark.parametrize(
    ("limits_s", "leave", "words"),
    [
        ({"ANSWER_S": 1}, lambda local: local.close(), "connection to the scheduler .* was lost"),
        (
            {"POLL_S": 0.2, "WORKERLESS_S": 0.2},
            lambda local: local.scale(0),
            r"no workers for 0\.2 s",
        ),
    ],
    ids=["scheduler", "workers"],
)
def test_a_scheduler_or_workers_that_go_away_are_one_sentence(
    limits_s: dict[str, float],
    leave: Callable[[Any], object],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, limit_s in limits_s.items():
        monkeypatch.setattr(cluster, name, limit_s)
    with (
        local_cluster(1) as local,
        pytest.raises(MachineError, match=f"{words}.*resume"),
    ):
        call(local.scheduler_address, time.sleep, 60, meanwhile=lambda: leave(local))


def test_a_wrong_address_and_a_lack_of_workers_are_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster, "ANSWER_S", 0.5)
    monkeypatch.setattr(cluster, "JOIN_S", 0.5)
    with local_cluster(0) as local:
        for address, words in (
            ("tcp://127.0.0.1:1", "127.0.0.1:1 does not answer: .*tcp://host:8786"),
            ("foo://a:1", "foo://a:1 does not answer: .*tcp://host:8786"),
            (local.scheduler_address, "dask worker"),
        ):
            with pytest.raises(MachineError, match=words), open_cluster(address):
                pass


def test_a_worker_of_another_version_is_refused() -> None:
    class Client:
        def run(self, _function: object, package: str, on_error: str) -> dict[str, str]:
            assert on_error == "return"
            return {"tcp://worker": "0.0" if package == "numpy" else version(package)}

    with pytest.raises(
        MachineError, match=r"worker tcp://worker must have numpy \d.*got 0\.0\..*the same versions"
    ):
        cluster._require_same_versions(Client())


WITHOUT_TORCH = """
import importlib.metadata
import sys

sys.modules["torch"] = None  # an import of it raises ModuleNotFoundError
version = importlib.metadata.version


def version_of(package):
    if package == "torch":
        raise importlib.metadata.PackageNotFoundError(package)
    return version(package)


importlib.metadata.version = version_of
from beers_deploy.cli.commands import app

app(sys.argv[1:])
"""


def test_restores_where_torch_is_not_installed(image: Path, scheduler: str, tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    options = f"--network convbeers-xs-int8 --scheduler {scheduler}".split()
    words = ("restore", str(image), str(out), *options)
    process = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, *words], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert tifffile.imread(out).shape == tifffile.imread(image).shape


def test_a_missing_dask_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(MachineError, match=r"pip install 'beers-deploy\[dask\]'"),
        open_cluster("host:8786"),
    ):
        pass
