"""Judge restorations on simulated pairs: every method sees the same degraded images."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from deploy.defaults import default_int8, float_model
from deploy.restore import MAX_DN, TILE_PX, restore_image
from deploy.results import Row, measured, unavailable
from model.metrics.fidelity import psnr_db, ssim
from model.simulator.acquire import MARGIN_PX, Pair, simulate_pair
from model.simulator.draws import Draw
from model.simulator.scene import Scene
from model.traditional.pipeline import Chain, restore_traditional
from model.weights_file import shipped_weights
from profiles.errors import OptionError
from profiles.sensor import SensorProfile
from quant.onnx_file import load_onnx
from quant.radius import receptive_radius_px
from quant.session import open_session

Method = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""

OVERSAMPLINGS = (4, 2)
MIN_SIDE_PX = 48


@dataclass(frozen=True)
class NamedPair:
    """A simulated pair and the scene it came from."""

    name: str
    pair: Pair


def simulate_pairs(
    scenes: list[Scene], degraded: SensorProfile, reference: SensorProfile, seed: int
) -> tuple[list[NamedPair], list[str]]:
    """Simulate a pair of each scene, at the larger oversampling that leaves enough of it.

    Returns:
        The pairs, and the names of scenes too small to use.
    """
    pairs, small = [], []
    for number, scene in enumerate(scenes):
        ratio = next(
            (r for r in OVERSAMPLINGS if min(scene.radiance.shape) // r >= 2 * MARGIN_PX + MIN_SIDE_PX), None
        )
        if ratio is None:
            small.append(scene.name)
            continue
        draw = Draw(seed, number)
        eyes = [profile.draw(draw.generator("sensor")) for profile in (degraded, reference)]
        pairs.append(NamedPair(scene.name, simulate_pair(scene.radiance, eyes[0], eyes[1], ratio, draw)))
    return pairs, small


def method_named(name: str, degraded: SensorProfile, reference: SensorProfile) -> Method:
    """`degraded`, `traditional`, a shipped variant, that variant with `-int8`, or the path of an ONNX file.

    Raises:
        OptionError: no such method.
    """
    if name == "degraded":
        return lambda dn: dn
    if name == "traditional":
        chain = Chain(degraded.nominal(), reference.nominal())
        return lambda dn: restore_traditional(torch.from_numpy(dn), chain).numpy()
    return _network(name)


def _network(name: str) -> Method:
    path = Path(name)
    if path.suffix == ".onnx":
        model = load_onnx(path)
    elif path.suffix == ".safetensors":
        model = float_model(path)
    elif name == default_int8().stem:
        model = load_onnx(default_int8())
    elif name.startswith("convbeers"):
        model = float_model(shipped_weights(name))
    else:
        expected = "degraded, traditional, a shipped network such as convbeers-s or convbeers-s-int8, or an ONNX file"
        raise OptionError("--methods", expected=expected, got=repr(name), remedy="correct that name")
    session, halo_px = open_session(model), receptive_radius_px(model)
    return lambda dn: restore_image(dn, session, TILE_PX, halo_px).astype(np.float32)


def score(name: str, method: Method, pairs: list[NamedPair], tick: Callable[[], None]) -> list[Row]:
    """The mean row, and one row an image."""
    rows = []
    for item in pairs:
        restored = method(item.pair.degraded.numpy())
        rows.append(fidelity_row("images", f"{name}: {item.name}", restored, item.pair.reference.numpy()))
        tick()
    return [mean_row(name, rows), *rows]


def fidelity_row(table: str, name: str, dn: np.ndarray, reference: np.ndarray) -> Row:
    """PSNR and SSIM of (H, W) digital numbers over 4095 DN."""
    source = "simulated pair"
    psnr = psnr_db(dn, reference, MAX_DN)
    identical = "infinite: identical to the reference"
    figures = {
        "PSNR": measured(psnr, "dB", source) if np.isfinite(psnr) else unavailable("dB", identical),
        "SSIM": measured(ssim(dn, reference, MAX_DN), "ratio", source),
    }
    return Row(table, name, figures)


def mean_row(name: str, rows: list[Row]) -> Row:
    """The mean of each figure over the rows that have it."""
    figures = {}
    for key, first in rows[0].figures.items():
        values = [value for row in rows if (value := row.figures[key].value) is not None]
        source = f"mean of {len(values)} simulated pairs"
        figures[key] = measured(float(np.mean(values)), first.unit, source) if values else first
    return Row("mean", name, figures)
