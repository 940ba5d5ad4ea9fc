"""Networks of torch from their files and into them, and a network's weights as the start of a wider one's."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from model.conditioning import ConditionedConvBEERS, Network
from model.convbeers import ConvBEERS, plain_network
from model.io.tensors import Weights, read_conditioned, read_plain, write_weights

N = TypeVar("N", ConvBEERS, ConditionedConvBEERS)


def arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors of any shape as arrays."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def save_network(path: Path, network: Network, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them."""
    weights = Weights(arrays(network.state_dict()), network.variant, dict(recipe))
    write_weights(path, weights, isinstance(network, ConditionedConvBEERS))


def load_network(path: Path) -> tuple[ConvBEERS, dict[str, object]]:
    """Read a network in evaluation mode, and its recipe.

    Raises:
        ModelError: not our weights, or weights of another shape.
    """
    found = read_plain(path)
    return plain_network(found.tensors, found.variant), found.recipe


def load_conditioned(path: Path) -> tuple[ConditionedConvBEERS, dict[str, object]]:
    """Read a network that is conditioned on its sensor, in evaluation mode, and its recipe.

    Raises:
        ModelError: not such weights, or of other ranges of sensors than this version's.
    """
    found = read_conditioned(path)
    network = ConditionedConvBEERS(found.variant)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in found.tensors.items()})
    return network.eval(), found.recipe
