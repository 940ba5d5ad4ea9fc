"""Tests of the command `check`: its tables, its document and its verdict."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.graph.split_network import REMEDY
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.deploy.dpu.graphs import (
    MYSTERY,
    SAME,
    board_convbeers,
    float_convbeers,
    integer_convbeers,
    written,
)
from tests.quant.quick import fix_sizes


def tables(path: Path) -> dict[str, list[dict[str, Any]]]:
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in valid(path)["rows"]:
        by_name.setdefault(row["table"], []).append(row)
    return by_name


@pytest.mark.parametrize("make", [float_convbeers, integer_convbeers, board_convbeers])
def test_convbeers_passes_whole_in_every_encoding(
    make: Callable[[Path, int, int], Path], tmp_path: Path
) -> None:
    out = tmp_path / "o.json"
    output = done("check", make(tmp_path / "n.onnx", 16, 64), "--json", out)
    assert "check passed" in output
    assert valid(out)["verdict"] == "passed"
    (summary,) = tables(out)["summary"]
    assert summary["figures"]["DPU subgraphs"]["value"] == 1


def test_a_network_of_one_tile_is_checked_at_that(tmp_path: Path) -> None:
    model = onnx.load(float_convbeers(tmp_path / "n.onnx", 2, 8))
    for value in (*model.graph.input, *model.graph.output):
        fix_sizes(value, 96, 96)
    onnx.save(model, tmp_path / "fixed.onnx")
    assert "tile 96" in done(f"check {tmp_path}/fixed.onnx")
    assert "--tile 96" in refused(f"check {tmp_path}/fixed.onnx --tile 640")


def test_the_document_contains_subgraphs_cuts_and_remarks(tmp_path: Path) -> None:
    nodes = f"a = {SAME}(image, w) b = Sigmoid(a) y = {SAME}(b, w)"
    onnx.save(written(nodes), tmp_path / "bad.onnx")
    output = done(f"check {tmp_path}/bad.onnx --tile 96 --json {tmp_path}/o.json", code=1)
    rows = tables(tmp_path / "o.json")
    assert [row["text"]["device"] for row in rows["subgraphs"]] == ["DPU", "CPU", "DPU"]
    assert [row["figures"]["size"]["value"] for row in rows["cuts"]] == [8 * 96 * 96] * 4
    assert {row["name"] for row in rows["remarks"]} == {"fix2float", "subgraphs"}
    (summary,) = rows["summary"]
    counts = {key: figure["value"] for key, figure in summary["figures"].items()}
    assert counts == {"DPU subgraphs": 2, "nodes refused": 1}
    document = valid(tmp_path / "o.json")
    check, acceptance = document["checks"]
    assert not acceptance["passed"]
    limit = {"unit": "node", "limit": 0, "bound": "at most"}
    expected = {"name": "nodes the DPU refuses", "value": 1, "passed": False, **limit}
    assert document["verdict"] == "failed"
    assert expected.items() <= check.items()
    verdict = " ".join(output.split()).rpartition("check FAILED: ")[2]
    assert verdict.startswith("nodes the DPU refuses 1 (")


def test_devices_and_refusals_are_shown_and_nodes_in_detail(tmp_path: Path) -> None:
    """Nodes are listed with -v only. Each broken rule has its count and a remedy."""
    nodes = f"a = {SAME}(image, w) b = Sigmoid(a) c = Sigmoid(b) y = {SAME}(c, w)"
    onnx.save(written(nodes), tmp_path / "bad.onnx")
    command = f"check {tmp_path}/bad.onnx --tile 96 --json {tmp_path}/o.json"
    brief = done(command, code=1)
    rows = tables(tmp_path / "o.json")
    assert {row["name"]: row["figures"]["count"]["value"] for row in rows["devices"]} == {
        "DPU": 2,
        "CPU": 2,
    }
    (refusal,) = rows["refusals"]
    assert refusal["figures"]["count"]["value"] == 2
    assert refusal["text"]["remedy"]
    assert refusal["name"][:20] in brief
    assert len(rows["nodes"]) == 4
    detailed = done(f"{command} -v", code=1)
    headings = {"devices": "where the nodes run", "nodes": "nodes"}
    for name, shown in (("devices", True), ("nodes", False)):
        assert (headings[name] in map(str.strip, brief.splitlines())) == shown
        assert headings[name] in map(str.strip, detailed.splitlines())


def test_an_unknown_size_is_not_shown_as_zero(tmp_path: Path) -> None:
    onnx.save(written(MYSTERY), tmp_path / "m.onnx")
    output = done(f"check {tmp_path}/m.onnx --json {tmp_path}/o.json", code=1)
    modes = [row["figures"]["size"]["mode"] for row in tables(tmp_path / "o.json")["cuts"]]
    assert modes.count("unavailable") == 2
    assert "its shape is unknown" in output


def test_check_and_quantize_agree_on_a_float_file(tmp_path: Path) -> None:
    """Both give the same reason, so that no network passes one and is refused by the other."""
    supported = float_convbeers(tmp_path / "taken.onnx", 1, 8)
    unsupported = tmp_path / "other.onnx"
    model = onnx.load(supported)
    # The last node is the global add.
    model.graph.node[-1].op_type = "Div"
    onnx.save(model, unsupported)
    assert "it fits once 'quantize' has rewritten it" in done(f"check {supported}")
    with pytest.raises(ModelError) as error:
        read_network(model)
    output = " ".join(done(f"check {unsupported}", code=1).split())
    assert str(error.value).removesuffix(f" {REMEDY}") in output


def test_check_of_an_int8_file_does_not_mention_quantize(tmp_path: Path) -> None:
    assert "'quantize'" not in done("check", integer_convbeers(tmp_path / "int8.onnx", 1, 8))
