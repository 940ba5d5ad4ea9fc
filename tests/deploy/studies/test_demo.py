import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import tifffile

import beers_deploy as bd
from beers_deploy.profiles.errors import MissingExtraError, OptionError
from beers_deploy.profiles.shipped import HERE, board_names
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.studies import demo
from tests.deploy.command_line import done
from tests.deploy.documents import figures_of, valid


@pytest.mark.slow
def test_the_demo_runs_the_whole_chain_on_a_raw_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This test uses two patches. The first stage of .ci/run uses all."""
    monkeypatch.setattr("beers_deploy.verbs.demo.GATE_PATCHES", 2)
    raw = tmp_path / "raw.tif"
    tifffile.imwrite(
        raw, np.random.default_rng(0).integers(300, 1500, (120, 150)).astype(np.uint16)
    )
    text = (HERE / "sensors" / "pleiades-degraded.toml").read_text()
    mine = tmp_path / "mine.toml"
    mine.write_text(text.replace("10.2375", "10.0"))
    out = tmp_path / "out"
    figures = tmp_path / "figures.json"
    output = done("demo", "--image", raw, "--out", out, "--json", figures, "--sensor", mine)
    assert f"report: {out / 'report.html'}\n" in output
    images = {"restored.tif", "before-after.png"}
    networks = {"float.onnx", "int8.onnx", "core.onnx"}
    assert {path.name for path in out.iterdir()} == {"report.html", *images, *networks}
    assert tifffile.imread(out / "restored.tif").shape == (120, 150)
    document = valid(figures)
    assert document["arguments"]["sensor"] == str(mine)
    assert metadata(onnx.load(out / "int8.onnx"))["sensor"] == "mine"
    modes = {figure["mode"] for figure in figures_of(document["rows"])}
    assert {"measured", "predicted", "published"} <= modes
    page = (out / "report.html").read_text()
    assert "fits the DPU whole" in page
    boards = [row for row in document["rows"] if row["table"] == "boards"]
    assert [row["name"].split()[0] for row in boards] == board_names()
    assert "no power of vek280 under its DPU is published" in page


@pytest.mark.parametrize("package", ["skimage", "matplotlib"])
def test_a_missing_package_is_named_before_anything_is_written(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"{package}.*pip install 'beers-deploy\["):
        bd.demo(out=tmp_path / "out")
    assert not list(tmp_path.rglob("*.*"))


@pytest.mark.slow
def test_the_reference_has_the_gain_of_the_sensor_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise every pixel would be off by the ratio of the gains, and the PSNR would be wrong."""
    monkeypatch.setattr(demo, "SIDE_PX", 128)
    text = (HERE / "sensors" / "pleiades-degraded.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("10.2375", "5.0"))
    pair = demo.read_input(None, 0, demo.load_sensors(str(tmp_path / "mine.toml")))[1]
    assert pair is not None
    assert abs(float(pair.degraded.mean() / pair.reference.mean()) - 1) < 0.01
    (tmp_path / "wide.toml").write_text(text.replace("bits = { value = 12", "bits = { value = 14"))
    with pytest.raises(OptionError, match=r"`sensor` must have 12 bits, but wide has 14\."):
        demo.load_sensors(str(tmp_path / "wide.toml"))
