from pathlib import Path

from deploy.dpu.board import load_dpu
from deploy.dpu.checker.operators import rule_text
from deploy.dpu.checker.placement import Placement, place
from deploy.dpu.checker.table import REMARKS, remarks_on
from deploy.dpu.reading import read_network
from tests.deploy.dpu.graphs import Sketch, integer_convbeers

DPU = load_dpu("vck190")


def placed(path: Path, tile_px: int) -> Placement:
    return place(read_network(path, tile_px), DPU)


def test_maps_stream_from_the_tile_on_that_the_remark_names(tmp_path: Path) -> None:
    path = integer_convbeers(tmp_path / "i.onnx", 1, 32)
    text = remarks_on(placed(path, 640), DPU, 640)["streaming"]
    assert "tiles of 181 px and less" in text  # 32 channels at 181 x 181 are the last below 1 MiB
    assert "streaming" not in remarks_on(placed(path, 181), DPU, 181)
    assert "streaming" in remarks_on(placed(path, 182), DPU, 182)


def test_the_last_conversion_runs_on_the_cpu(tmp_path: Path) -> None:
    placement = placed(integer_convbeers(tmp_path / "i.onnx", 1, 8), 64)
    (leaving,) = (cut.tensor for cut in placement.cuts if not cut.onto_dpu)
    assert leaving in remarks_on(placement, DPU, 64)["fix2float"]


def test_subgraphs_are_counted(tmp_path: Path) -> None:
    sketch = Sketch(8)
    path = sketch.save(tmp_path / "s.onnx", sketch.conv(sketch.node("Sigmoid", sketch.conv("image"))))
    assert remarks_on(placed(path, 32), DPU, 32)["subgraphs"].startswith("2 DPU subgraphs")
    assert "subgraphs" not in remarks_on(placed(integer_convbeers(tmp_path / "i.onnx", 1, 8), 32), DPU, 32)


def test_remarks_read_with_the_targets_limits() -> None:
    texts = [rule_text(remark, DPU) for remark in REMARKS]
    assert not [text for text in texts if "{" in text or "(" not in text]
