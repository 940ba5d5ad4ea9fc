"""ConvBEERS as ONNX: `image` (N, 1, H, W) in [0, 1] to `restored`, written node by node under readable names."""

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

from deploy import __version__
from model.convbeers import ConvBEERS
from quant.onnx_file import image_info, make_model
from quant.session import open_session, run


def to_onnx(network: ConvBEERS, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """The network as an ONNX model; `tile_px` fixes one square image, None leaves number and size free."""
    writer = _Writer({name: value.numpy() for name, value in network.state_dict().items()})
    stream = head = writer.conv("head", "image")
    for k in range(network.variant.blocks):
        inner = writer.node("Relu", f"body.{k}.relu", [writer.conv(f"body.{k}.first", stream)])
        stream = writer.node("Add", f"body.{k}.add", [stream, writer.conv(f"body.{k}.second", inner)])
    deep = writer.node("Add", "body_end.add", [head, writer.conv("body_end", stream)])
    writer.node("Add", "restored", ["image", writer.conv("tail", deep)])
    ends = [image_info("image", 1, tile_px)], [image_info("restored", 1, tile_px)]
    graph = helper.make_graph(writer.nodes, "convbeers", *ends, writer.weights)
    return make_model(graph, {"beers_deploy_version": __version__, "precision": "float32", **about})


def parity(network: ConvBEERS, path: Path, side_px: int) -> float:
    """Largest absolute difference between torch and onnxruntime on one random image, in [0, 1] of full scale."""
    image = np.random.default_rng(0).random((1, 1, side_px, side_px), dtype=np.float32)
    with torch.inference_mode():
        expected = network(torch.from_numpy(image)).numpy()
    return float(np.abs(run(open_session(path), image) - expected).max())


class _Writer:
    """Collects nodes and weights; a node's result goes by the node's name."""

    def __init__(self, state: dict[str, np.ndarray]) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights = [numpy_helper.from_array(value, name) for name, value in state.items()]

    def node(self, kind: str, name: str, inputs: list[str], **attributes: list[int]) -> str:
        node = helper.make_node(kind, inputs, [name], name=name)
        node.attribute.extend(helper.make_attribute(key, value) for key, value in attributes.items())
        self.nodes.append(node)
        return name

    def conv(self, name: str, source: str) -> str:
        feeds = [source, f"{name}.weight", f"{name}.bias"]
        return self.node("Conv", name, feeds, pads=[1] * 4, kernel_shape=[3, 3])
