"""A network as the short list of operations that a DPU computes: what quantisation works on.

- `nodes`: the one reading of an ONNX file, for `check` and tiling too, with `moves` of pixels in
  one spelling and how numbers are `quantized`;
- `operations`: what there is, convolutions to pixel shuffles, which tensors must share a scale, and
  how 12 bits enter int8;
- `reader`: from float ONNX to a `network`, cut where the host's part ends;
- `writer`: back to float ONNX.
"""

from beers_deploy.quant.graph.network import Network, channels_of, check_network
from beers_deploy.quant.graph.operations import (
    COARSE_MAX,
    CORRECTION,
    IMAGE,
    PLANES,
    PLANES_FRAC_BITS,
    QUARTER,
    STEP,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Mul,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    Window,
    read_planes,
    same,
    tensors,
    tied,
    ties_scales,
)
from beers_deploy.quant.graph.reader import (
    correction_graph,
    image_channels,
    plain_network,
    read_network,
    refusal,
)
from beers_deploy.quant.graph.writer import graph_to_onnx

__all__ = [
    "COARSE_MAX",
    "CORRECTION",
    "IMAGE",
    "PLANES",
    "PLANES_FRAC_BITS",
    "QUARTER",
    "STEP",
    "Activation",
    "Add",
    "AveragePool",
    "Concat",
    "Conv",
    "Graph",
    "MaxPool",
    "Mul",
    "Network",
    "Op",
    "Pointwise",
    "Resize",
    "Shuffle",
    "Window",
    "channels_of",
    "check_network",
    "correction_graph",
    "graph_to_onnx",
    "image_channels",
    "plain_network",
    "read_network",
    "read_planes",
    "refusal",
    "same",
    "tensors",
    "tied",
    "ties_scales",
]
