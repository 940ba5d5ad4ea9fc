"""What a board's engineer is handed: the host's part gives the host file's bytes, and the record says what it is."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

import beers_deploy as bd
from beers_deploy.kit.golden import read_golden
from beers_deploy.kit.record import NAMES
from tests.deploy.command_line import done
from tests.deploy.kit.test_golden import network

BARE = """
import sys
class Bare:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("beers_deploy", "torch", "scipy", "onnx", "PIL"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Bare())
sys.argv = ["host.py", *sys.argv[2:]]
import runpy
runpy.run_path("host.py", run_name="__main__")
"""


@pytest.mark.parametrize("name", ["convbeers-xs-int8", "convbeers-half-xs-int8", "unet", "espcn"])
def test_the_host_part_gives_the_host_files_bytes(name: str, tmp_path: Path) -> None:
    """On a Python with NumPy and onnxruntime alone, on a swath of odd sides."""
    int8 = network(name)
    folder = bd.Board.load("vck190").kit(int8, tmp_path / "kit", tile=96)
    image = np.random.default_rng(1).random((1, 131, 203), dtype=np.float32)
    np.save(tmp_path / "image.npy", image)
    command = [sys.executable, "-c", BARE, "-", str(tmp_path / "image.npy"), str(tmp_path / "out.npy")]
    subprocess.run(command, cwd=folder, check=True)
    lattice_px, scale = int8.tiling.lattice_px, int(int8.tiling.scale)
    wide = np.pad(image, [(0, 0), *((0, -side % lattice_px) for side in image.shape[1:])], "edge")
    whole = int8(wide[None])[0][:, : 131 * scale, : 203 * scale]
    assert np.array_equal(np.load(tmp_path / "out.npy"), whole)
    assert {"core.onnx", "measure.py", "README.md", "golden"} < {path.name for path in folder.iterdir()}
    read = onnx.load(folder / "golden" / "core.onnx").graph.input[0].type.tensor_type.shape.dim
    assert [side.dim_value for side in read][1:] == [
        *np.load(folder / "golden" / "noise" / "00-planes.npy").shape[1:]
    ]
    assert len((folder / "host.py").read_text(encoding="utf-8").replace("\n\n", "\n").splitlines()) < 65


def test_a_record_says_what_a_network_is_and_what_was_checked(tmp_path: Path) -> None:
    pair = "convbeers-xs", "convbeers-xs-int8"
    done("gate", *pair, "--patches", 2, "--record", tmp_path / "gate")
    said = json.loads((tmp_path / "gate" / NAMES[0]).read_text(encoding="utf-8"))
    assert said["passed"]
    assert said["licence"] == "Apache-2.0"
    assert len(said["training"]["images"]) >= 50
    assert said["network"]["sha256"] in {each["sha256"] for each in said["results"]["inputs"]}
    assert len(said["tool"]["code_sha256"]) == 64
    text = (tmp_path / "gate" / NAMES[2]).read_text(encoding="utf-8")
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(text) is None
    assert "All checks passed" in (tmp_path / "gate" / NAMES[1]).read_text(encoding="utf-8")


def test_of_a_users_network_nothing_is_made_up(tmp_path: Path) -> None:
    folder = bd.Board.load("zcu102").kit(network("unet"), tmp_path / "kit", tile=32, record=True)
    said = json.loads((folder / "record" / NAMES[0]).read_text(encoding="utf-8"))
    assert (said["training"], said["licence"], said["weights_sha256"], said["sensors_in_range"]) == (None,) * 4
    assert len(said["calibration_samples"]) == 3
    onnx.checker.check_model(onnx.load(folder / "core.onnx"))


def test_for_an_npu_the_core_is_what_its_compiler_reads(tmp_path: Path) -> None:
    folder = bd.Board.load("vek385").kit("convbeers-xs-int8", tmp_path / "kit", tile=48)
    assert "ve2-xc2ve3858" in (folder / "vitisai_config.json").read_text(encoding="utf-8")
    assert read_golden(folder / "golden").half_even
    assert bd.check(folder / "core.onnx", "vek385")
