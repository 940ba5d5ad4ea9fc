"""What is trained held to the integer reference: the same whole numbers, whatever the parameters
have become.
"""

from collections.abc import Sequence

import numpy as np
import torch

from beers_deploy.quant.core import IntCore
from beers_deploy.quant.ends import FINE_MAX
from beers_deploy.quant.graph import CORRECTION
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.integer.trainable import TrainableCore


def moved(core: IntCore) -> TrainableCore:
    """A core whose weights and biases training has moved by a unit or so."""
    generator = torch.Generator().manual_seed(3)
    trainable = TrainableCore(core)
    with torch.no_grad():
        for numbers in trainable.parameters():
            numbers.add_(0.7 * torch.randn(numbers.shape, generator=generator))
    return trainable


def hold_to_reference(trainable: TrainableCore, planes: np.ndarray) -> None:
    """Fail where a tensor differs; a correction in copies may by half a unit where a fine copy
    holds it.
    """
    core = trainable.core()
    wanted, _ = run_core(core, planes)
    with torch.no_grad():
        found = trainable.tensors(torch.from_numpy(planes.astype(np.float32)))
        result = trainable(torch.from_numpy(planes.astype(np.float32))).numpy()
    ends = core.ends
    whole = merged_correction(core, wanted)
    for name, values in wanted.items():
        if name != CORRECTION or ends.copies == 1:
            np.testing.assert_array_equal(found[name].numpy(), values, err_msg=name)
    if ends.copies == 1:
        np.testing.assert_allclose(result, whole, rtol=1e-6)
        return
    fine = _fine(
        np.split(np.abs(wanted[CORRECTION]), ends.copies, axis=1), windows=bool(ends.offsets)
    )
    assert (
        fine.any() or not ends.offsets
    )  # windows hold all, the fine one of two gains what is small
    assert np.abs(result - whole)[fine].max(initial=0) <= 0.501 * core.scale(CORRECTION)


def _fine(sizes: Sequence[np.ndarray], windows: bool) -> np.ndarray:
    """Where one of the fine copies holds the value: all but the first of windows, the first of two
    gains.
    """
    return np.asarray(np.min(sizes[1:] if windows else sizes[:1], axis=0) <= FINE_MAX)
