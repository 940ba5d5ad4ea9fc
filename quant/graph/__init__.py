"""Represent a network as the short list of operations that a DPU computes, which quantisation works
on.

- `operations`: the operations, from convolutions to pixel shuffles, and how 12 bits enter int8;
- `ties`: which tensors must share a scale;
- `reader`: from float ONNX (`node_operations`, one by one) to a `split_network`, cut where the
  host's part ends; `plain` accepts networks of ConvBEERS' kind only;
- `writer`: back to float ONNX;
- `mirror` and `host_end`: what the host does in front of the core, and computes behind it, such as
  an activation, and the `base` that a result is added to;
- `attention`, `deviation` and `normalization`: replace what a DPU lacks, for reader and
  `quant.adapt`;
- `pixel_shuffle`, `quantized`: what checker and tiling read from a file as well.
"""

from beers_deploy.quant.graph.operations import (
    COARSE_MAX,
    CORRECTION,
    IMAGE,
    LEAKY_SLOPE,
    PLANES,
    PLANES_FRAC_BITS,
    QUARTER,
    SIX,
    STEP,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Mul,
    OneInput,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    fold_full_scale,
    read_planes,
    same,
    tensors,
)
from beers_deploy.quant.graph.plain import correction_graph, image_channels
from beers_deploy.quant.graph.reader import read_network, refusal
from beers_deploy.quant.graph.split_network import (
    SplitNetwork,
    channels_of,
    check_split,
    require_one_image,
)
from beers_deploy.quant.graph.ties import tied, ties_scales
from beers_deploy.quant.graph.writer import graph_to_onnx
from beers_deploy.quant.onnx.window import Window

__all__ = [
    "COARSE_MAX",
    "CORRECTION",
    "IMAGE",
    "LEAKY_SLOPE",
    "PLANES",
    "PLANES_FRAC_BITS",
    "QUARTER",
    "SIX",
    "STEP",
    "Activation",
    "Add",
    "AveragePool",
    "Concat",
    "Conv",
    "Graph",
    "MaxPool",
    "Mul",
    "OneInput",
    "Op",
    "Pointwise",
    "Resize",
    "Shuffle",
    "SplitNetwork",
    "Window",
    "channels_of",
    "check_split",
    "correction_graph",
    "fold_full_scale",
    "graph_to_onnx",
    "image_channels",
    "read_network",
    "read_planes",
    "refusal",
    "require_one_image",
    "same",
    "tensors",
    "tied",
    "ties_scales",
]
