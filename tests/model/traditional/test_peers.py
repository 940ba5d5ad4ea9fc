"""scikit-image's restorations: better than the input, behind the chain, sound on any shape."""

import pytest
import torch
from torch import Tensor

from model.simulator.acquire import Pair, simulate_pair
from model.simulator.detector import Draw
from model.traditional.peers import PEERS
from model.traditional.pipeline import Chain, restore_traditional
from profiles import load_sensor

CHAIN = Chain(load_sensor("pleiades-degraded").nominal(), load_sensor("pleiades-reference").nominal())


@pytest.fixture(scope="module")
def pair(camera: Tensor) -> Pair:
    return simulate_pair(camera[64:267, 128:337] * (200 / 255), CHAIN.degraded, CHAIN.reference, 1, Draw(seed=1))


def psnr_db(image: Tensor, truth: Tensor) -> float:
    difference = (image - truth)[8:-8, 8:-8].double()
    return float(10 * torch.log10(4095**2 / difference.square().mean()))


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_gains_decibels_and_stays_behind_the_chain(name: str, pair: Pair) -> None:
    """Were a peer misled about gain, shift or target MTF, it would lose, and flatter the chain."""
    before, after = (psnr_db(image, pair.reference) for image in (pair.degraded, PEERS[name](pair.degraded, CHAIN)))
    chain = psnr_db(restore_traditional(pair.degraded, CHAIN), pair.reference)
    assert before + 3 < after < chain


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.parametrize("shape", [(37, 53), (14, 21)])
def test_any_shape_comes_back_within_range(name: str, shape: tuple[int, int], pair: Pair) -> None:
    restored = PEERS[name](pair.degraded[: shape[0], : shape[1]], CHAIN)
    assert restored.shape == shape
    assert bool(torch.isfinite(restored).all())
    assert 0 <= float(restored.min()) <= float(restored.max()) <= 4095


@pytest.mark.parametrize("name", PEERS)
def test_the_brightness_is_kept(name: str, pair: Pair) -> None:
    restored = PEERS[name](pair.degraded, CHAIN)
    assert float(restored.mean() / pair.degraded.mean()) == pytest.approx(1, abs=5e-3)
