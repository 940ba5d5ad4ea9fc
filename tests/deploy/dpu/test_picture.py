import re
from itertools import chain, pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.picture import FILLS, draw, require_picture, write_picture
from beers_deploy.dpu.checker.placement import Placement, place
from beers_deploy.dpu.reading import read_network
from beers_deploy.profiles.errors import OptionError
from tests.deploy.dpu.graphs import Sketch, float_convbeers
from tests.deploy.report.svg import style_of, text_width

SVG = "{http://www.w3.org/2000/svg}"


def of_class(root: ET.Element, kind: str, tag: str) -> list[ET.Element]:
    """Elements within the groups of a class."""
    return root.findall(f".//{SVG}g[@class='{kind}']/{SVG}{tag}")


def drawn(placement: Placement, title: str = "net") -> ET.Element:
    return ET.fromstring(draw(placement, title))  # noqa: S314 - our own output


def placed(path: Path) -> Placement:
    return place(read_network(path, 40), load_dpu("vck190"))


def test_every_node_is_drawn_in_its_devices_colour_and_says_which(tmp_path: Path) -> None:
    sketch = Sketch(8)
    middle = sketch.node("Sigmoid", sketch.conv("image"))
    placement = placed(sketch.save(tmp_path / "s.onnx", sketch.conv(middle)))
    root = drawn(placement, "a < b & c")
    boxes = of_class(root, "dot", "path")
    labels = [text.text for text in of_class(root, "device", "text")][len(FILLS) :]
    devices = [node.device for node in placement.nodes]
    assert devices == ["DPU", "CPU", "DPU"]
    assert labels == devices
    assert [style_of(box)["fill"] for box in boxes] == [FILLS[device] for device in devices]
    assert [
        group.findtext(f"{SVG}title")
        for group in root.iter(f"{SVG}g")
        if group.get("class") == "dot"
    ] == [f"{node.op.op_type}  {node.op.name}" for node in placement.nodes]
    words = [t.text or "" for t in root.iter(f"{SVG}text")]
    assert "Sigmoid always runs on the CPU" in " ".join(words)
    assert words[0] == "a < b & c"


@pytest.mark.parametrize("blocks", [1, 9])
def test_every_word_is_seen_on_a_phone(blocks: int, tmp_path: Path) -> None:
    """At its own size: a wider picture is cut off at 390 pixels, or its words scaled down."""
    sketch = Sketch(8)
    conv = sketch.node("Sigmoid", sketch.conv("image", (8, 8, 17, 33)))
    refused = placed(sketch.save(tmp_path / "s.onnx", sketch.conv(conv)))
    deep = placed(float_convbeers(tmp_path / "f.onnx", blocks, 8))
    for placement in (refused, deep):
        root = drawn(placement, "a-network-with-quite-a-long-name.onnx on vck190 C32B3, tile 640")
        assert float(root.get("width") or 0) <= 390
        texts = list(root.iter(f"{SVG}text"))
        for text in texts:
            assert float(text.get("x") or 0) + text_width(text.text or "", 13) <= 390
        rows = [float(text.get("y") or 0) for text in of_class(root, "beside", "text")]
        assert all(lower - upper >= 13 for upper, lower in pairwise(rows)), "lines below each other"
        assert float(root.get("height") or 0) > max(rows)
        for path in of_class(root, "edge", "path"):
            assert all(
                float(number) >= 0 for number in re.findall(r"-?[0-9.]+", path.get("d") or "")
            )
    for node in refused.nodes:
        assert node.op.name in draw(refused, "net")


def test_edges_join_writers_to_readers(tmp_path: Path) -> None:
    placement = placed(float_convbeers(tmp_path / "f.onnx", 2, 8))
    outputs = set(chain.from_iterable(node.op.outputs for node in placement.nodes))
    inputs = chain.from_iterable(node.op.inputs for node in placement.nodes)
    reads = sum(name in outputs for name in inputs)
    edges = of_class(drawn(placement), "edge", "path")
    assert len(edges) == reads
    curves = ["C" in (edge.get("d") or "") for edge in edges]
    assert sum(curves) == 3, "the skips of two blocks and the long one"


def test_fills_are_light_enough_for_black_text_and_apart_in_brightness() -> None:
    def luminance(fill: str) -> float:
        """WCAG 2.1 relative luminance."""
        parts = [int(fill[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    assert all((luminance(fill) + 0.05) / 0.05 > 7 for fill in FILLS.values())


def test_a_page_and_a_drawing(tmp_path: Path) -> None:
    placement = placed(float_convbeers(tmp_path / "f.onnx", 1, 8))
    for name, start in (("g.svg", "<svg"), ("g.html", "<!doctype html>")):
        write_picture(placement, "net", tmp_path / name)
        assert (tmp_path / name).read_text().startswith(start)
    assert "prefers-color-scheme: dark" in (tmp_path / "g.svg").read_text()


def test_other_endings_are_refused() -> None:
    require_picture(None)
    with pytest.raises(OptionError, match=r"\.svg or \.html"):
        require_picture(Path("graph.png"))
