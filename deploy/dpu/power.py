"""Power of a run on the DPU: an anchored assumption, not a model.

One published board run stands behind it (paper, table of the VCK190 benchmark). No idle figure is published, so
idle and dynamic power cannot be told apart, and the figure does not change with network or configuration. The range
is the published DPU run give or take its distance from the published CPU run.
"""

from deploy.dpu.board import Dpu
from deploy.results import Figure, predicted


def dpu_power(dpu: Dpu) -> Figure:
    """Power in W while the DPU runs, with the range assumed for it."""
    anchor, assumed = dpu.limit("power", "dpu_run_w"), dpu.limit("power", "dpu_range_w")
    source = f"assumption anchored at {anchor.source}; range: {assumed.source}"
    return predicted(anchor.low, "W", (assumed.low, assumed.high), source)
