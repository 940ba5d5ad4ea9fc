"""Sharpness and noise that a method leaves, measured on targets whose truth is known: slanted edges and flat fields.

Targets are acquired by the degraded sensor as scenes are, restored by the method, and measured as if found in an
image. The MTF is that of edges of a step of 160 W/m2/sr/um; a method that adapts to its input may treat fine texture
otherwise. The noise in flat fields is what is left where nothing is to be seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import stdtrit
from torch import Tensor

from beers_deploy.model.io.images import MAX_DN
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import edge_mtf, slanted_edge
from beers_deploy.model.simulator.acquire import acquire
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import scene_spectrum
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.profiles.sensor import Instrument
from beers_deploy.studies.evaluation.methods import Method

ANGLES_DEG = (3.0, 5.0, 8.0, 11.0)
REPEATS = 3
OVERSAMPLING, SIDE_PX, EDGE_PX, FLAT_PX = 5, 240, 80, 128
RADIANCES = (25.0, 100.0)
"""Of the flat fields, W/m2/sr/um."""


@dataclass(frozen=True)
class Targets:
    """Acquired targets, (H, W) digital numbers, and what the sensor adds.

    Attributes:
        edges: angle in degrees, and the edge; each with independent noise.
        flats: radiance in W/m2/sr/um, and the field.
        max_dn: the digital number at which an edge is saturated.
        offset_dn: the digital number of the dark, no part of a signal.
    """

    edges: Sequence[tuple[float, np.ndarray]]
    flats: Sequence[tuple[float, np.ndarray]]
    max_dn: int = MAX_DN
    offset_dn: float = 0.0


def acquire_targets(sensor: Instrument, seed: int) -> Targets:
    """Edges at several angles with independent noise, and flat fields at 25 and 100 W/m2/sr/um."""
    edges = []
    for number, angle_deg in enumerate(ANGLES_DEG * REPEATS):
        scene = slanted_edge(SIDE_PX, OVERSAMPLING, angle_deg)
        edges.append((angle_deg, _acquire(scene, sensor, Draw(seed, number))))
    flats = []
    for number, radiance in enumerate(RADIANCES):
        scene = torch.full((FLAT_PX, FLAT_PX), radiance)
        flats.append((radiance, _acquire(scene, sensor, Draw(seed, len(edges) + number), ratio=1)))
    return Targets(edges, flats, sensor.max_dn, sensor.offset_dn)


def _acquire(scene: Tensor, sensor: Instrument, draw: Draw, ratio: int = OVERSAMPLING) -> np.ndarray:
    return acquire(scene_spectrum(scene), scene.shape[1], sensor, ratio, draw, "degraded", margin_px=0).numpy()


def snr_name(radiance: float) -> str:
    """The name of the SNR in a flat field of a radiance in W/m2/sr/um."""
    return f"SNR at {radiance:g} W/m2/sr/um"


def target_figures(method: Method, targets: Targets) -> dict[str, Figure]:
    """MTF at Nyquist in %, and SNR in flat fields, of what the method makes of the targets."""
    figures = {"MTF at Nyquist": mtf_figure(restored_mtfs(method, targets))}
    for radiance, flat in targets.flats:
        figures[snr_name(radiance)] = flat_figure(_middle(method.restore(flat)) - targets.offset_dn)
    return figures


def restored_mtfs(method: Method, targets: Targets) -> list[float | Refusal]:
    """What the instrument says of each restored edge."""
    return [edge_mtf(_middle(method.restore(edge)), angle, targets.max_dn) for angle, edge in targets.edges]


def _middle(image: np.ndarray) -> np.ndarray:
    top, left = ((side - EDGE_PX) // 2 for side in image.shape)
    return image[top : top + EDGE_PX, left : left + EDGE_PX]


def mtf_figure(found: Sequence[float | Refusal]) -> Figure:
    """The mean over the edges with its 90 % interval; unavailable where most edges were refused."""
    values = [100 * each for each in found if not isinstance(each, Refusal)]
    refused = [each for each in found if isinstance(each, Refusal)]
    if len(values) < max(len(refused), 2):
        return unavailable("%", f"{len(refused)} of {len(found)} edges refused: {refused[0].reason}")
    reach = float(stdtrit(len(values) - 1, 0.95)) * float(np.std(values, ddof=1)) / len(values) ** 0.5
    mean = float(np.mean(values))
    source = f"{len(values)} of {len(found)} simulated slanted edges, 90 % interval of the mean"
    return measured(mean, "%", source, (mean - reach, mean + reach))


def flat_figure(flat: np.ndarray) -> Figure:
    """Mean over standard deviation of a flat field (h, w), about its mean: the linear SNR there."""
    mean, deviation = float(flat.mean(dtype=np.float64)), float(flat.std(dtype=np.float64, ddof=1))
    if deviation <= 1e-6 * mean:
        return unavailable("ratio", "nothing is left of the noise in a flat field")
    return measured(mean / deviation, "ratio", f"one flat field of {flat.shape[1]} x {flat.shape[0]}, L / sigma")
