"""Tests of the names of `import beers_deploy`: arguments, results, and errors for bad input."""

import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile
import torch
from numpy.testing import assert_allclose, assert_array_equal

import beers_deploy as bd
from beers_deploy.model.shipped import shipped_names
from beers_deploy.profiles.sensor import numbers_of
from beers_deploy.profiles.shipped import board_names, sensor_names
from tests.deploy.documents import valid
from tests.deploy.restoration.runs import simulated
from tests.quant.quick import uniform

SMALL = "convbeers-xs"


class Tiny(torch.nn.Module):
    """Two convolutions that change an image a little."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.head = torch.nn.Conv2d(1, 4, 3, padding=1)
        self.tail = torch.nn.Conv2d(4, 1, 3, padding=1)
        for weight in self.parameters():
            weight.data = 0.1 * torch.randn(weight.shape, generator=generator)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return an image of the same shape."""
        change: torch.Tensor = self.tail(torch.relu(self.head(image)))
        return image + change


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    return uniform(8, 1, 32, 32)


@pytest.fixture(scope="module")
def tiny() -> bd.Network:
    return bd.Network.load(Tiny())


@pytest.fixture(scope="module")
def int8(tiny: bd.Network, samples: np.ndarray) -> bd.Network:
    return bd.quantize(tiny, samples=samples, target="zcu102", progress=False)


@pytest.fixture(scope="module")
def pair() -> bd.Pair:
    return simulated(size=70, seed=1)


@pytest.fixture(scope="module")
def raw() -> np.ndarray:
    return np.random.default_rng(2).integers(200, 3000, (61, 83)).astype(np.uint16)


@pytest.mark.parametrize("name", sensor_names())
def test_a_saved_sensor_is_the_same(name: str, tmp_path: Path) -> None:
    sensor = bd.Sensor.load(name)
    assert numbers_of(bd.Sensor.load(sensor.save(tmp_path / "s.toml"))) == numbers_of(sensor)


def test_another_number_of_a_sensor_keeps_the_others() -> None:
    sensor = bd.Sensor.load("pleiades-degraded")
    sharper = sensor.replace(mtf_nyquist=(0.1, 0.2), alpha=0.002, beta=0.01)
    assert (sharper.mtf_nyquist.low, sharper.mtf_nyquist.high) == (0.1, 0.2)
    assert sharper.noise([0.0, 100.0]) == pytest.approx([0.1, 0.21**0.5])
    assert sharper.snr_0 is None
    assert sharper.gsd_m == sensor.gsd_m
    assert_allclose(sensor.to_radiance(sensor.to_dn(np.array([3.0, 70.0]))), [3, 70])


def test_values_are_copied_and_compared(tiny: bd.Network) -> None:
    tiny(np.zeros((1, 1, 8, 8), np.float32))
    for value in (bd.Sensor.load("blind"), bd.Board.load("vck190"), tiny):
        assert copy.deepcopy(value) == value
        assert len(repr(value)) < 150


def test_a_module_computes_as_in_torch(tiny: bd.Network) -> None:
    images = uniform(2, 1, 19, 23, seed=1)
    with torch.inference_mode():
        expected = Tiny()(torch.from_numpy(images)).numpy()
    assert_allclose(tiny(images), expected, atol=1e-6)
    assert (tiny.precision, tiny.tiling.halo_px) == ("float32", 2)


def test_a_module_is_exported_with_an_input_of_it_in_any_default_type(tiny: bd.Network) -> None:
    """torch.onnx.export accepts the input as well, and a notebook may compute in float64."""
    module = Tiny()
    torch.set_default_dtype(torch.float64)
    try:
        loaded = bd.Network.load(module, example=torch.rand(1, 1, 8, 8))
    finally:
        torch.set_default_dtype(torch.float32)
    assert_array_equal(loaded(np.ones((1, 1, 9, 9))), tiny(np.ones((1, 1, 9, 9))))


def test_a_network_is_loaded_from_a_path_a_model_or_a_network(
    tiny: bd.Network, tmp_path: Path
) -> None:
    path = tiny.save(tmp_path / "tiny.onnx")
    for source in (str(path), path, onnx.load(path), tiny):
        network = bd.Network.load(source)
        assert_array_equal(network(np.ones((1, 1, 9, 9))), tiny(np.ones((1, 1, 9, 9))))


def test_an_int8_network_has_its_float_network_and_its_layers(
    tiny: bd.Network, int8: bd.Network
) -> None:
    assert int8.origin == tiny
    assert int8.precision == "int8"
    assert [row.table for row in int8.layers] == ["integer layers", "integer layers", "rounding"]


def test_the_gate_notes_the_samples_of_the_calibration(
    int8: bd.Network, samples: np.ndarray
) -> None:
    verdict = bd.gate(int8, samples=samples, target="zcu102", limits={"mae": 0.01})
    verdict.raise_if_failed()
    assert "6 of 8 samples calibrated it" in verdict.notes[0]
    assert verdict.comparison.result.patches == 8
    with pytest.raises(
        AssertionError, match=r"gate FAILED, 1 of \d checks: MAE .* allowed at most 1e-09"
    ):
        bd.gate(int8, samples=samples, limits={"mae": 1e-9}).raise_if_failed()


@pytest.mark.parametrize("kind", ["tuple", "list", "batches", "file"])
def test_samples_of_any_kind_are_the_same(
    kind: str, tiny: bd.Network, int8: bd.Network, samples: np.ndarray, tmp_path: Path
) -> None:
    np.save(tmp_path / "samples.npy", samples)
    forms: dict[str, Any] = {
        "tuple": (samples, samples),
        "list": list(samples),
        "batches": [[batch] for batch in (samples[:3], torch.from_numpy(samples[3:]))],
        "file": str(tmp_path / "samples.npy"),
    }
    network = bd.quantize(tiny, samples=forms[kind], target="zcu102", progress=False)
    assert_array_equal(network(samples), int8(samples))


def test_a_board_runs_a_network_at_a_predicted_speed(int8: bd.Network) -> None:
    result = bd.check(int8, target="zcu102")
    assert result
    assert (result.refused, result.failed) == ((), ())
    boards: list[Any] = ["zcu102", bd.Board.load("vck190")]
    speed = bd.bench(int8, target=boards, size=(3000, 2000), traditional=False)
    assert speed.arguments["target"] == "zcu102, vck190"
    frame = speed.to_pandas()
    names = [name for table, name in frame.index if table == "sweep"]
    assert names == ["zcu102 B4096, tiles of 640", "vck190 C32B3, tiles of 640"]
    assert frame.attrs["units"]["latency"] == "s"
    tidy = speed.to_pandas(tidy=True)
    rate = tidy[tidy.figure == "throughput"].iloc[0]
    assert rate.low < rate.value < rate.high
    assert rate["mode"] == "predicted"
    assert speed.layers == []
    one = bd.bench(int8, target="zcu102", traditional=False)
    assert len(one.layers) > 2
    assert one.plot("time").get_xlabel() == "time (ms/batch)"


def test_a_table_is_a_document_and_shows_itself(int8: bd.Network, tmp_path: Path) -> None:
    table = bd.bench(int8, target="all", traditional=False)
    document = valid(table.save(tmp_path / "figures.json"))
    assert document["inputs"][0]["sha256"] == int8.sha256
    assert document == {**table.to_dict(), "host": document["host"]}
    page = table._repr_html_()
    assert page.count("<tr>") == len(table.rows) + len(table.shown())
    assert 'title="cost model fitted on published networks' in page
    assert len(repr(table)) < 200


def test_a_kit_has_the_expected_results_of_its_core(int8: bd.Network, tmp_path: Path) -> None:
    folder = bd.Board.load("zcu102").kit(int8, tmp_path / "kit", tile=32)
    core = bd.Network.load(folder / "core.onnx")
    assert core(np.load(folder / "input.npy")) == pytest.approx(np.load(folder / "expected.npy"))
    assert (folder / "measure.py").read_text(encoding="utf-8").startswith("#!/usr/bin/env python3")


@pytest.mark.slow
def test_a_pair_in_memory_is_evaluated_as_one_of_files(pair: bd.Pair, tmp_path: Path) -> None:
    degraded, reference = pair
    assert degraded.shape == reference.shape == pair.clean.shape == (70, 70)
    from_files = bd.evaluate(
        methods=["convbeers-half-xs"], pairs=pair.save(tmp_path / "pairs"), progress=False
    )
    ways: dict[str, Any] = {"network": "convbeers-half-xs", "half": lambda dn: dn / 2}
    in_memory = bd.evaluate(methods=ways, pairs=[pair], progress=False)
    names = {row.name: row.figures for row in in_memory.rows if row.table == "mean"}
    assert set(names) >= {"degraded", "network", "half"}
    assert names["network"]["PSNR"].value == next(
        row.figures["PSNR"].value for row in from_files.rows if row.name == "convbeers-half-xs"
    )
    assert (names["network"]["PSNR"].value or 0) > (names["half"]["PSNR"].value or 0)
    assert pair._repr_html_().count("<img") == 3
    assert repr(pair) == "Pair(70 x 70 px, pleiades-degraded -> pleiades-reference)"
    assert pair.ssim(pair.reference) == 1 > pair.ssim(pair.degraded) > 0
    # NumPy would drop the imaginary part.
    with pytest.raises(bd.BeersError, match="must have integer or float pixels, got complex128"):
        pair.psnr(pair.reference * 1j)
    scene = np.full((700, 800), 90.0, np.float32)
    assert simulated(images=scene).degraded.shape == (76, 96)
    assert {row.name for row in bd.boards().rows} == set(board_names())
    assert [row.text["precision"] for row in bd.networks().rows] == ["float32", "int8"] * len(
        shipped_names()
    )


def test_tensors_and_masked_arrays_are_returned_as_such(raw: np.ndarray) -> None:
    expected = bd.restore(raw, network=SMALL)
    tensor = bd.restore(torch.from_numpy(raw), network=SMALL)
    assert torch.equal(tensor, torch.from_numpy(expected))
    for pixels, fill in ((raw, 65535), (raw.astype(np.float32), np.nan)):
        masked = np.ma.array(pixels, mask=raw < 400)
        restored = bd.restore(masked, network=SMALL)
        filled = np.where(masked.mask, pixels.dtype.type(fill), pixels)
        nodata = None if fill != fill else fill
        expected_pixels = bd.restore(filled, network=SMALL, nodata=nodata)
        assert_array_equal(restored.mask, masked.mask)
        assert_array_equal(restored.compressed(), expected_pixels[~masked.mask])


def test_the_bands_of_xarray_are_found_by_name(raw: np.ndarray) -> None:
    xarray = pytest.importorskip("xarray", reason="no xarray")
    bands = np.stack([raw, raw[::-1], raw // 2])
    expected = bd.restore(bands, network=SMALL)
    last = xarray.DataArray(
        np.moveaxis(bands, 0, -1), dims=("y", "x", "band"), coords={"band": [1, 2, 3]}
    )
    restored = bd.restore(last, network=SMALL)
    assert restored.dims == last.dims
    assert_array_equal(restored.transpose("band", "y", "x").values, expected)
    scaled = xarray.DataArray(
        (raw // 16).astype(np.uint8), dims=("y", "x"), attrs={"full_scale": 255}
    )
    assert bd.restore(scaled, network=SMALL).dtype == np.uint8


def test_a_file_needs_an_output(raw: np.ndarray, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "raw.tif", raw)
    with pytest.raises(bd.BeersError, match="`out` is missing"):
        bd.restore(tmp_path / "raw.tif")


REFUSED: dict[str, tuple[Callable[[np.ndarray], object], str]] = {
    "bands last": (lambda raw: bd.restore(np.stack([raw] * 3, -1)), "moveaxis"),
    "no array": (lambda _: bd.restore(3), "but it is int"),
    "an array with out": (
        lambda raw: bd.restore(raw, "a.tif"),
        "`out` has no effect with an array",
    ),
    "a file's nodata": (
        lambda _: bd.restore("raw.tif", "a.tif", nodata=0),
        "`nodata` has no effect with an image file, which states its own",
    ),
    "no network": (lambda _: bd.Network.load(3), r"torch.nn.Module"),  # type: ignore[arg-type]
    "a COG of an array": (
        lambda raw: bd.restore(raw, cog=True),
        "`cog` has no effect with an array",
    ),
    "8 bits": (lambda raw: bd.restore(raw.astype(np.uint8)), "full_scale"),
    "shares": (lambda raw: bd.restore(raw / 4095), "full_scale"),
    "INT8 again": (lambda _: bd.quantize(f"{SMALL}-int8"), "an INT8 network"),
    "no INT8 network": (
        lambda _: bd.gate("float.onnx"),
        "INT8 network of float.onnx is missing.*`int8_network`",
    ),
    "a module's INT8 network": (
        lambda _: bd.gate(Tiny()),
        "INT8 network of Tiny is missing.*`int8_network`",
    ),
    "no shipped pair": (lambda _: bd.gate("convbeers-m"), "no shipped weights 'convbeers-m'"),
    "no pairs": (
        lambda raw: bd.quantize(Tiny(), samples=(raw[None, None], raw[None, None].repeat(2, 0))),
        "a reference for each",
    ),
    "no sample": (lambda _: bd.quantize(Tiny(), samples=3), "or a path"),
    "no batch": (lambda raw: bd.quantize(Tiny(), samples=[raw]), "a batch of"),
    "for one sensor": (
        lambda _: bd.quantize(bd.Network.load(SMALL)),
        "Give '.*' or its file, and `sensor`",
    ),
    "no raw image": (lambda _: bd.characterize([]), "one or several"),
    "no module's size": (
        lambda _: bd.Network.load(Tiny(), example=(1, 9, 8, 8)),
        "torch cannot export the module Tiny",
    ),
    "no swath": (lambda _: bd.bench(SMALL, size=(0, 0)), r"`size` .*\(0, 0\)"),
    "one side": (lambda _: bd.bench(SMALL, size=5), "`size` must be WIDTHxHEIGHT"),  # type: ignore[arg-type]
    "half a pixel": (
        lambda _: bd.bench(SMALL, size="64x64", tile=32.5),  # type: ignore[arg-type]
        "`tile` must be sides",
    ),
    "no name of a board": (lambda _: bd.bench(SMALL, target=5), "A board must be"),  # type: ignore[arg-type]
    "no limits": (lambda _: bd.gate(SMALL, limits=5), "`limits` must be Limits"),  # type: ignore[arg-type]
    "no name of a method": (lambda _: bd.evaluate(methods=5), "`methods` must be names"),  # type: ignore[arg-type]
    "no list of pairs": (
        lambda raw: bd.evaluate(methods="degraded", pairs=[raw]),  # type: ignore[list-item]
        "`pairs` must be a folder",
    ),
    "no factor": (
        lambda _: bd.evaluate(methods="degraded", brightness=[None]),  # type: ignore[list-item]
        "`brightness` must be numbers",
    ),
    "an array with pairs": (
        lambda raw: bd.evaluate(methods="degraded", pairs="pairs", brightness=raw),  # type: ignore[arg-type]
        "`brightness` has no effect with `pairs`",
    ),
    "an array of choices": (
        lambda raw: bd.simulate(preset=raw),  # type: ignore[arg-type]
        "`preset` must be one of",
    ),
    "a float as a size": (lambda _: bd.simulate(size=64.0), "`size` must be an integer"),  # type: ignore[arg-type]
    "no size": (lambda _: bd.simulate(size=0), "`size` must be from 1 to 4096"),
    "other sizes": (lambda raw: simulated(size=48).psnr(raw), r"`image` has the shape \(61, 83\)"),
    "no figure": (lambda _: bd.sensors().plot("x"), "`figure` must be one of MTF.*'x'"),
    "no number": (lambda _: bd.Sensor.load("blind").replace(mtf=1), "mtf_nyquist"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_raises_a_value_error_of_one_sentence(case: str, raw: np.ndarray) -> None:
    call, words = REFUSED[case]
    with pytest.raises(ValueError, match=words) as caught:
        call(raw)
    assert isinstance(caught.value, bd.BeersError)
    assert "--" not in str(caught.value)
    assert "\n" not in str(caught.value)


WITHOUT_EXTRAS = """
import sys


class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "matplotlib", "pycocotools", "skimage", "pandas"):
            raise ModuleNotFoundError("blocked", name=name)


sys.meta_path.insert(0, Blocked())
import numpy as np
import beers_deploy as bd

samples = np.load("samples.npy")
image = np.full((40, 50), 900, np.uint16)
int8 = bd.quantize("tiny.onnx", samples=samples, progress=False)
assert bd.gate(int8, samples=samples, limits={"mae": 0.01}) and bd.check(int8)
assert any("needs the package torch" in note for note in bd.bench(int8).notes)
assert bd.restore(image, network="convbeers-xs-int8").shape == (40, 50)
assert bd.restore(image, network="convbeers-xs", sensor="pleiades-degraded").shape == (40, 50)
pair = bd.simulate(size=48)
assert pair.degraded.shape == (48, 48)
for call, extra in (
    (lambda: bd.quantize("tiny.onnx", samples=samples, finetune=1, progress=False), "torch"),
    (lambda: bd.evaluate(methods="degraded"), "torch"),
    (lambda: bd.restore(image, method="traditional", sensor="pleiades-degraded"), "torch"),
    (lambda: bd.sensors().plot(), "study"),
    (lambda: pair.ssim(pair.degraded), "study"),
    (lambda: bd.sensors().to_pandas(), "notebook"),
):
    try:
        call()
    except ImportError as error:
        assert isinstance(error, bd.BeersError) and f"beers-deploy[{extra}]" in str(error), error
    else:
        raise AssertionError(extra)
"""


def test_the_core_needs_no_extra(tiny: bd.Network, samples: np.ndarray, tmp_path: Path) -> None:
    tiny.save(tmp_path / "tiny.onnx")
    np.save(tmp_path / "samples.npy", samples)
    subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS], cwd=tmp_path, check=True, timeout=120)
