import hashlib
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.float_onnx import banked_to_onnx, float_for, to_onnx
from beers_deploy.model.bank import network_bank
from beers_deploy.model.convbeers import ConvBEERS, arrays, for_sensor, save_network, vector_tensor
from beers_deploy.model.io.tensors import Weights
from beers_deploy.model.shipped import shipped_names, shipped_weights
from beers_deploy.model.variants import Variant
from beers_deploy.network import Network
from beers_deploy.parity import require_parity, torch_network
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import metadata, save_onnx
from beers_deploy.quant.session import open_session, run
from beers_deploy.quant.tiling.receptive_field import tiling_of
from tests.deploy.command_line import done, refused
from tests.deploy.kit import test_golden
from tests.model.networks import behind_a_bank, plain, radius_px
from tests.profiles.own_sensor import own_sensor
from tests.quant.quick import uniform
from tests.quant.tiling.small_networks import quantized_half_resolution


@pytest.fixture(scope="module")
def network() -> ConvBEERS:
    return plain(Variant(blocks=2, features=8))


@pytest.mark.parametrize("scale", [1, 2, 3])
@pytest.mark.parametrize("tile_px", [None, 36])
def test_torch_and_onnxruntime_agree(scale: int, tile_px: int | None, tmp_path: Path) -> None:
    network = plain(Variant(2, 8, scale))
    path = tmp_path / "float.onnx"
    save_onnx(to_onnx(network, {"variant": "test"}, tile_px), path)
    assert require_parity(network, path, tile_px or 33) < 1e-6
    assert fixed_tile_px(onnx.load(path)) == tile_px
    assert metadata(onnx.load(path))["variant"] == "test"
    if scale > 1:
        with pytest.raises(
            OptionError, match=f"`tile` must be a multiple of {scale} px, but it is 41 px"
        ):
            to_onnx(network, {}, 41)


@pytest.mark.parametrize("name", shipped_names())
def test_torch_and_onnxruntime_agree_on_shipped_weights(name: str) -> None:
    weights = shipped_weights(name)
    sensor = Sensor.load("pleiades-degraded")
    require_parity(torch_network(weights, sensor.nominal()), float_for(weights, name, sensor), 38)


@pytest.mark.parametrize(("scale", "rows", "columns"), [(1, 37, 29), (2, 38, 46)])
def test_a_network_behind_a_bank_is_exported_for_one_sensor(
    scale: int, rows: int, columns: int
) -> None:
    """Its filters, unit and head's bias are constants then, and its results are those of torch."""
    banked = behind_a_bank(Variant(1, 8, scale), 0.1)
    sensor = Sensor.load("pleiades-degraded").nominal()
    model = banked_to_onnx(Weights(arrays(banked.state_dict()), banked.variant, {}), sensor, {})
    image = uniform(2, 1, rows, columns, seed=1) * 0.02 + 0.4
    with torch.inference_mode():
        expected = for_sensor(banked, vector_tensor(sensor), network_bank(sensor))(
            torch.from_numpy(image)
        ).numpy()
    np.testing.assert_allclose(run(open_session(model), image), expected, atol=2e-6)
    placed = place(sized_graph(model, 64), load_dpu("vck190", "C32B6"))
    assert [node.op.name for node in placed.nodes if node.broken] == []
    tiling = tiling_of(model)
    assert tiling.alignment_px == scale
    assert tiling.halo_px == radius_px(banked.variant) + (3 if scale == 1 else 4)


def test_quantize_names_the_weights_of_an_export_for_one_sensor(tmp_path: Path) -> None:
    done(f"export --network convbeers-xs --out {tmp_path}/float.onnx")
    message = refused(f"quantize {tmp_path}/float.onnx --out {tmp_path}/int8.onnx")
    assert "'export' wrote this file for one sensor" in message
    assert "Quantise the shipped name" in message


def test_a_network_that_gives_nan_is_not_exported(network: ConvBEERS, tmp_path: Path) -> None:
    weights = tmp_path / "run.safetensors"
    out = tmp_path / "float.onnx"
    # A far too high learning rate leads to such weights: they are finite, but the pixels are not.
    overflowing = ConvBEERS(network.variant)
    state = {name: value * 1e25 for name, value in network.state_dict().items()}
    overflowing.load_state_dict(state)
    save_network(weights, overflowing.eval(), {})
    message = refused(f"export --network {weights} --out {out}")
    assert "returns NaN or infinity" in message
    assert "largest difference" not in message
    assert not out.exists()
    save_network(weights, network, {})
    done(f"export --network {weights} --out {out}")


def test_an_export_with_other_results_is_refused(network: ConvBEERS) -> None:
    with pytest.raises(ModelError, match="report it"):
        require_parity(plain(network.variant, seed=1), to_onnx(network, {}), 33)


def test_plain_weights_accept_no_sensor_and_conditioned_ones_use_the_default(
    network: ConvBEERS, conditioned: Path, tmp_path: Path
) -> None:
    plain_weights = tmp_path / "plain.safetensors"
    out = tmp_path / "x.onnx"
    save_network(plain_weights, network, {})
    useless = refused(f"export --network {plain_weights} --sensor pleiades-degraded --out {out}")
    assert "train --conditioned" in useless
    assert not out.exists()
    done(f"export --network {conditioned} --out {out}")
    assert metadata(onnx.load(out))["sensor"] == "pleiades-degraded"


SMALL = "convbeers-xs-int8"


@pytest.mark.parametrize(
    ("sensor", "factors"),
    [("pleiades-degraded", [0.5, 4, 16]), ("dior-medium", [0.5, 2, 8]), ("dior-high", [0.5, 2])],
)
def test_the_deltas_of_exposures_give_the_networks_that_restore_runs(
    sensor: str, factors: list[float], tmp_path: Path
) -> None:
    """Each delta gives the same bytes, although it is applied to another sensor's INT8 file."""
    words = f"export --network {SMALL} --out {tmp_path}/x.onnx"
    output = done(f"{words} --sensor {sensor} --delta {tmp_path}/my.delta")
    expected = Network.load(SMALL, sensor=sensor).exposures
    assert sorted(expected) == factors
    names = ["my.delta", *(f"my-x{factor:g}.delta" for factor in factors)]
    assert sorted(path.name for path in tmp_path.glob("*.delta")) == sorted(names)
    for name in names:
        assert f"{name}: {(tmp_path / name).stat().st_size} bytes" in output.replace("\n", "")
    for factor in factors:
        delta = tmp_path / f"my-x{factor:g}.delta"
        applied = tmp_path / f"x{factor:g}.onnx"
        assert delta.stat().st_size < 3000
        done(f"export --network {SMALL} --apply {delta} --out {applied}")
        assert applied.read_bytes() == expected[factor].save(tmp_path / "e.onnx").read_bytes()


def test_a_damaged_delta_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.delta").write_bytes(b"none")
    files = f"--out {tmp_path}/x.onnx --apply {tmp_path}/bad.delta"
    message = refused(f"export --network {SMALL} {files}")
    assert "bad.delta is damaged" in message


def test_the_files_of_exposures_are_refused_before_any_work(tmp_path: Path) -> None:
    """A file is refused that is an input, another output, or a folder. So is an unknown sensor."""
    sensor = own_sensor(tmp_path).rename(tmp_path / "my-x4.toml")
    before = sensor.read_bytes()
    out = tmp_path / "my-x16.onnx"
    words = f"export --network {SMALL} --out {out} --delta"
    assert "an input of this run" in refused(f"{words} {tmp_path}/my.toml --sensor {sensor}")
    assert "another output" in refused(f"{words} {tmp_path}/my.onnx")
    (tmp_path / "my-x4.delta").mkdir()
    assert "my-x4.delta" in refused(f"{words} {tmp_path}/my.delta")
    assert "no profile 'hubble'" in refused(f"{words} {tmp_path}/d --sensor hubble")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my-x4.delta", "my-x4.toml"]
    assert sensor.read_bytes() == before


def test_a_core_is_written_as_c_for_a_tile(tmp_path: Path) -> None:
    words = f"export --network {SMALL} --out {tmp_path}/int8.onnx --c {tmp_path}/net.c"
    assert "--tile must be given for a C file" in refused(words)
    assert list(tmp_path.iterdir()) == []
    done(f"{words} --tile 32")
    text = (tmp_path / "net.c").read_text().replace("\n * ", " ")
    digest = hashlib.sha256((tmp_path / "int8.onnx").read_bytes()).hexdigest()
    assert f"int8.onnx, SHA-256 {digest}" in text
    assert "void run(const int8_t *in, int8_t *out)" in text
    assert "another output" in refused(f"{words.replace('net.c', 'int8.onnx')} --tile 32")


def test_the_core_of_a_user_s_network_is_written_as_it_is(tmp_path: Path) -> None:
    """The network is for one sensor, so another sensor is refused."""
    save_onnx(quantized_half_resolution().host, tmp_path / "own.onnx")
    words = f"export --network {tmp_path}/own.onnx --out {tmp_path}/tile.onnx --tile 32"
    done(f"{words} --c {tmp_path}/net.c")
    assert "void run(const int8_t *in, int8_t *out)" in (tmp_path / "net.c").read_text()
    assert "cannot be conditioned" in refused(f"{words} --sensor pleiades-degraded")


def test_a_tile_that_the_strides_do_not_divide_is_refused(tmp_path: Path) -> None:
    """No runtime would open the file."""
    test_golden.network("unet").save(tmp_path / "own.onnx")
    words = f"export --network {tmp_path}/own.onnx --out {tmp_path}/tile.onnx --tile"
    assert "a multiple of its strides" in refused(f"{words} 66")
    assert not (tmp_path / "tile.onnx").exists()
    done(f"{words} 64")
