"""Networks of torch from their files and into them, and a network's weights as the start of a wider one's."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from torch import Tensor

from model.convbeers import BankedConvBEERS, Network, banked_network, plain_network
from model.io.tensors import BANKED, Weights, kind_of, read_banked, read_plain, write_weights


def arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors of any shape as arrays."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def save_network(path: Path, network: Network, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them."""
    weights = Weights(arrays(network.state_dict()), network.variant, dict(recipe))
    write_weights(path, weights, isinstance(network, BankedConvBEERS))


def load_network(path: Path) -> tuple[Network, dict[str, object]]:
    """Read a network in evaluation mode, plain or behind a bank, and its recipe.

    Raises:
        ModelError: not our weights, of another shape, or for other ranges of sensors than this version's.
    """
    if kind_of(path) == BANKED:
        found = read_banked(path)
        return banked_network(found.tensors, found.variant), found.recipe
    found = read_plain(path)
    return plain_network(found.tensors, found.variant), found.recipe
