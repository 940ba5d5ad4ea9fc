"""Correct the prediction of a network by runs of related networks on the user's board: by kinship.

ln(measured / predicted rate) of a run is modelled as a sum of deviations: one that all runs of a
board have in common, one of networks with the same kinds of layers, one of the network, and one of
the single run. The shares of the variance in SHARES were chosen on the published networks, each
predicted without its family (docs/explanation/cost-model.md). The correction of a network is its
mean given the runs, and its interval narrows with the variance that they leave (kriging).
"""

import math
from collections.abc import Sequence

import numpy as np

from beers_deploy.dpu.board import Dpu, Levels
from beers_deploy.dpu.cost.work import FUSED
from beers_deploy.dpu.graph import Operation

SHARES = (0.15, 0.35, 0.25, 0.2)
"""Shares of the variance: of the board and what bounds the rate; of the kinds of layers; of the
network; of the network in one size on one configuration. The rest is the scatter of repeated runs.
"""


def levels_of(operations: Sequence[Operation], dpu: Dpu, bound: str) -> Levels:
    """Compute keys that are equal for two runs that have something in common.

    The keys stand for: the board and what limits the rate; the kinds of layers; the network; and
    the network at one size on one configuration.

    Args:
        operations: the operations of the network, in order.
        dpu: the configuration that the network runs on.
        bound: the part that limits the predicted rate, "host" or "DPU".

    Returns:
        Four hashes, one for each of SHARES.
    """
    computing = [op for op in operations if op.kind not in FUSED]
    # The window of a pool over a whole map is as large as the map, whatever the network.
    kinds = [
        (op.kind, op.kernel if op.weight_bytes else (0, 0), op.window.strides) for op in computing
    ]
    network = tuple((kind, op.channels) for kind, op in zip(kinds, computing, strict=True))
    place = (network, dpu.target.name, dpu.name, computing[0].out_shape)
    # Hashes, because levels are compared many times.
    return tuple(map(hash, ((dpu.target.name, bound), frozenset(kinds), network, place)))


def correction(of: Levels, runs: Sequence[tuple[Levels, float]]) -> tuple[float, float]:
    """Correct the prediction of a network by runs that were measured on the user's board.

    The more keys a run has in common with the network, the more it counts (kriging).

    Args:
        of: the keys of the network, as `levels_of` returns them.
        runs: the keys of each measured run, and its ln(measured / predicted rate).

    Returns:
        The factor by which the predicted rate is multiplied, and the factor in (0, 1] by which the
        width of its interval is multiplied; (1, 1) without runs.
    """
    if not runs:
        return 1.0, 1.0
    names = [levels for levels, _ in runs]
    scatter = (1 - sum(SHARES)) * np.eye(len(runs))
    covariance = scatter + [[_common(one, other) for other in names] for one in names]
    common = np.array([_common(of, one) for one in names])
    weights = np.linalg.solve(covariance, common)
    ratio = float(weights @ [ratio for _, ratio in runs])
    return math.exp(ratio), math.sqrt(1 - float(weights @ common))


def _common(one: Levels, other: Levels) -> float:
    pairs = zip(SHARES, one, other, strict=True)
    return math.fsum(share for share, a, b in pairs if a == b)
