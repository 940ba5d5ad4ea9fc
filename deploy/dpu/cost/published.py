"""The published networks as cases for the fit."""

import math
from collections import defaultdict
from functools import cache

from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.cost.constants import Structure
from deploy.dpu.cost.fit import Case, Cases
from deploy.dpu.cost.host import host_work
from deploy.dpu.cost.layers import Layers
from deploy.dpu.cost.work import count_work, largest_map_bytes
from deploy.dpu.zoo.networks import NETWORKS, family, network, published_rates, read_bytes


@cache
def boards() -> tuple[str, ...]:
    """Boards with published rates."""
    return tuple(dict.fromkeys(rate.board for rate in published_rates()))


@cache
def published_cases(board: str, structure: Structure) -> Cases:
    """The published rates of a board, one case a network and configuration."""
    found = defaultdict(list)
    for rate in published_rates():
        if rate.board == board:
            found[rate.network, rate.configuration].append(rate)
    rows = (
        network_case(
            name,
            _dpu(board, configuration),
            tuple(rate.fps for rate in rates),
            tuple(rate.fps_single for rate in rates if rate.fps_single),
        )
        for (name, configuration), rates in found.items()
    )
    return Cases(tuple(rows), structure)


def network_case(name: str, dpu: Dpu, fps: tuple[float, ...], fps_single: tuple[float, ...] = ()) -> Case:
    """One of NETWORKS on a configuration, with its rates."""
    net = network(name)
    sizes = {op.output: op.out_bytes for op in net.operations}
    taken = sum(math.prod(shape) for shape in net.inputs.values())
    host = host_work(taken, sum(sizes[result] for result in net.outputs), read_bytes(name), NETWORKS[name].host)
    layers = Layers.of(count_work(net.operations, dpu), dpu)
    cores, largest = dpu.whole("cpu", "cores"), largest_map_bytes(net.operations)
    return Case(name, family(name), dpu.name, layers, host, cores, fps, fps_single, largest)


@cache
def _dpu(board: str, configuration: str) -> Dpu:
    return load_dpu(board, configuration)
