"""Quantise a network in one call: float ONNX and calibration patches in, the integer core and its
file for the host out.

1. Read the network, let it read bit planes, and take the image out of the long skip connection of a
   distillation network.
2. Find the residual groups and the single tensors, whose channels may be scaled.
3. Choose the scale of each tensor by least squares.
4. Exclude groups in which int8 could not end at a ReLU6's six.
5. Write a result to which nothing is added in windows.
6. Equalise the channels of the groups, then those of the single tensors. Use no groups if they
   lose more with one scale each than with scales of their own.
7. Round the graph, which writes its copies last, to the integer core.
8. Train the integers and change scales, if requested.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from onnx import ModelProto

from beers_deploy.model.levels import INTERVAL
from beers_deploy.quant.core import SHIFTS, IntCore, Shifts
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import Graph, SplitNetwork, read_network, read_planes
from beers_deploy.quant.host_part import DualRange, HostPart, Plain
from beers_deploy.quant.input_range import to_shares
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.passes.dual_range import can_write_copies
from beers_deploy.quant.passes.effort import Effort
from beers_deploy.quant.passes.long_skip import activates_sums, split_long_skip
from beers_deploy.quant.passes.residual_groups import residual_groups
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.plan import Plan, carry_out, singles_of
from beers_deploy.quant.samples.coverage import KEY, histogram, range_from
from beers_deploy.quant.samples.patches import Patches

if TYPE_CHECKING:
    from beers_deploy.quant.passes.finetune import Tuning

PASSES = "fine_planes, long_skip, least_squares, shared_residual_scale, equalise, dual_gain"
"""The record in a file of the applied passes, in the words of the first files."""

FINETUNE = "finetune"
"""The key of the record of fine-tuning in a file."""


@dataclass(frozen=True)
class Quantized:
    """A quantised network.

    Attributes:
        host: the INT8 network as ONNX for onnxruntime: the integer core, and the host's pre- and
            post-processing.
        core: the integer core, which the DPU computes.
        graph: the float graph that was rounded to `core`, after the passes (equalised, with copies
            of its result).
        network: the float network before any pass, split into DPU and host part.
    """

    host: ModelProto
    core: IntCore
    graph: Graph
    network: SplitNetwork


def quantize_model(
    model: ModelProto,
    patches: Patches,
    about: dict[str, str],
    shifts: Shifts = SHIFTS,
    tuning: "Tuning | None" = None,
    passes: Passes = ALL,
    effort: Effort = Effort.normal,
    brightens: bool = False,
) -> Quantized:
    """Quantise a float network under the DPU's rules: int8, symmetric, per tensor, power-of-two
    scales.

    If the network adds its input image to the result (a global add), the host does so in 12 bits.
    Then only the correction that is added to the image is computed in int8.

    Args:
        model: the simplified float network.
        patches: the calibration patches.
        about: metadata that the INT8 file gets, by key, in addition to that of the float file.
        shifts: the smallest and largest shifts that the target allows.
        tuning: the parameters of fine-tuning; None does not train the integers.
        passes: the passes that reduce the error.
        effort: the effort of the search for equalisation factors.
        brightens: True if the patches may lack bright ground, as a user's own samples may. Factors,
            or scales without factors, are then also chosen for brightened images.

    Returns:
        The integer core, the host's ONNX file, and the float graph that was rounded.

    Raises:
        ModelError: an operation that the DPU does not compute, or weights too large to quantise.
    """
    # 1.
    network = read_network(model)
    host_part = HostPart.of(network, Plain(), patches.ranges)
    graph = read_planes(network.graph, host_part.full_scale)
    # Without a global add the result contains the image, which int8 has to represent anyway. In a
    # plain residual stream the search then clips more, which the gate counts.
    if passes.long_skip and network.adds_image and activates_sums(graph):
        graph = split_long_skip(graph)
    if passes.dual_range and network.adds_image and can_write_copies(graph):
        host_part = replace(host_part, decoding=DualRange())
    # 2.
    groups = residual_groups(graph)
    singles = singles_of(graph, host_part, groups)
    # Without a global add the image is in the tensors. Then scales that also fit bright ground left
    # fine-tuning less to gain: a depthwise network lost 0.56 instead of -0.05 dB (measured).
    brightens = brightens and (network.adds_image or tuning is None)
    plan = Plan(graph, host_part, groups, singles, shifts, passes, effort, brightens)
    # 3. to 7. are in `quant.plan`.
    core, final = carry_out(plan, patches.degraded)
    shares = (to_shares(image, patches.ranges) for image in patches.degraded)
    # The interval of the float network does not hold for the integers, whose errors are others.
    own = {key: value for key, value in metadata(model).items() if key != INTERVAL}
    about = {
        **own,
        "precision": "int8 legal",
        "calibration_sha256": patches.digest,
        KEY: range_from(sum(map(histogram, shares), np.zeros(1))).to_words(),
        **about,
        "passes": PASSES,
        "effort": effort,
    }
    # 8.
    if tuning:
        # Imported here because it needs torch, which no other step does.
        from beers_deploy.quant.passes.finetune import finetune
        from beers_deploy.quant.passes.scales import moved

        untrained = core
        core, steps = finetune(core, graph, tuning, shifts)
        about[FINETUNE] = (
            f"{steps} steps on {len(tuning.pairs)} patches, scales of {moved(untrained, core)} "
            "tensors moved"
        )
    return Quantized(host_model(core, about, fixed_tile_px(model)), core, final, network)
