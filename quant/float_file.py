"""A plane-reading graph written back as float ONNX, every tensor an output: what calibration looks at."""

import onnx
from onnx import TensorProto, helper, numpy_helper

from quant.graph import Conv, Graph
from quant.onnx_file import image_info, make_model
from quant.planes import COUNT, PLANES


def float_model(graph: Graph, outputs: list[str]) -> onnx.ModelProto:
    """The graph from `planes` (N, 3, H, W) float32 to the named tensors."""
    nodes: list[onnx.NodeProto] = []
    weights: list[onnx.TensorProto] = []
    for op in graph:
        if isinstance(op, Conv):
            weights += [numpy_helper.from_array(op.weight, f"{op.name}.weight")]
            weights += [numpy_helper.from_array(op.bias, f"{op.name}.bias")]
            result = f"{op.output}.linear" if op.relu else op.output
            feeds = [op.input, f"{op.name}.weight", f"{op.name}.bias"]
            nodes.append(helper.make_node("Conv", feeds, [result], name=op.name, pads=[op.pad_px] * 4))
            if op.relu:
                nodes.append(helper.make_node("Relu", [result], [op.output], name=f"{op.name}.relu"))
        else:
            nodes.append(helper.make_node("Add", list(op.inputs), [op.output], name=op.name))
    results = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["N", "C", "H", "W"]) for n in outputs]
    return make_model(helper.make_graph(nodes, "core", [image_info(PLANES, COUNT, None)], results, weights), {})
