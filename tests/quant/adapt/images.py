"""Images on which adapted networks are fitted and judged, and comparisons of networks."""

import numpy as np
import onnx

from beers_deploy.quant.adapt.adaptation import Adapted
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session, result_of
from tests.quant.quick import assert_same, image, without_references

TO_ORIGINAL = "PSNR to the original, compensated"


def one_image(pixels: np.ndarray) -> np.ndarray:
    """Return pixels (H, W) as a batch of one image of one channel."""
    return pixels[None, None].astype(np.float32)


def patches(count: int, seed: int, px: int = 48) -> Patches:
    """Return smooth images with noise, and the same without it as references."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:px, :px] / px
    pairs = []
    for phase in generator.uniform(0, 6, count):
        clean = 0.4 + 0.3 * np.sin(7 * rows + phase) * np.cos(5 * columns - phase)
        noise = generator.standard_normal((px, px))
        noisy = np.clip(clean + 0.03 * noise, 0, 1)
        pairs.append((one_image(noisy), one_image(clean)))
    return Patches(pairs, [degraded for degraded, _ in pairs])


SAMPLES = patches(8, 0)
HELD_OUT = patches(4, 1)
BARE = without_references(HELD_OUT)


def assert_same_on_any_size(model: onnx.ModelProto, other: onnx.ModelProto) -> None:
    """Check that two networks are equal but for the rounding of float32, on odd sizes too."""
    for size in ((37, 53), (8, 5), (1, 3)):
        assert_same(model, other, image(*size), rtol=1e-5, atol=2e-6)


def assert_near(adapted: Adapted, least_db: float) -> None:
    """Check the PSNR of an adapted network to the original one."""
    near = adapted.rows[-1].figures[TO_ORIGINAL].value
    assert near is not None
    assert near > least_db


def squared_error(model: onnx.ModelProto, other: onnx.ModelProto) -> float:
    """Return the mean squared difference between two networks on the held-out images."""
    session = open_session(model)
    other_session = open_session(other)
    errors = []
    for pixels in HELD_OUT.degraded:
        difference = result_of(session, pixels) - result_of(other_session, pixels)
        errors.append(np.square(difference).mean())
    return float(np.mean(errors))
