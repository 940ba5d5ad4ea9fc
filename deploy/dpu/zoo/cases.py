"""Published networks as cases for the fit."""

import math
from functools import cache

from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.cost import Profile
from deploy.dpu.fit import Case, Cases
from deploy.dpu.rates import Layers
from deploy.dpu.work import count_work
from deploy.dpu.zoo.networks import NETWORKS, network, published_rates


def published_cases(*, sorting: bool = False) -> Cases:
    """The published rates.

    Args:
        sorting: those whose host sorts boxes or key points, which the model cannot know and the fit leaves out.
    """
    chosen = [rate for rate in published_rates() if (NETWORKS[rate.network].host_reads == "sorts") is sorting]
    rows = tuple(network_case(rate.network, _dpu(rate.configuration), rate.fps) for rate in chosen)
    return Cases(rows, load_dpu().value("cost", "serial"))


def network_case(name: str, dpu: Dpu, fps: float) -> Case:
    """One of NETWORKS on a configuration, with its rate."""
    entry, net = NETWORKS[name], network(name)
    works = count_work(net.operations, dpu)
    sizes = {op.output: op.out_bytes for op in net.operations}
    taken = sum(math.prod(shape) for shape in net.inputs.values())
    read = 0 if entry.host_reads == "scores" else sum(sizes[result] for result in net.outputs)
    profile = Profile.of(net.operations, works)
    return Case(name, entry.family, dpu.name, Layers.of(works, dpu), dpu.batch, (taken, read), fps, profile)


@cache
def _dpu(configuration: str) -> Dpu:
    return load_dpu("vck190", configuration)
