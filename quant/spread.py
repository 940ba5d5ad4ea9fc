"""How the errors of INT8 are spread: over sizes, and over patches."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import onnxruntime as ort

from quant.planes import MAX_DN
from quant.session import run


@dataclass(frozen=True)
class Spread:
    """Differences of INT8 from float, both clipped to [0, 1].

    Attributes:
        counts: (2 * 4095 + 1,) pixels by their signed difference in whole DN, from -4095 on.
        mae: (K,) mean absolute difference of each patch, of full scale.
        largest: (K,) largest difference of each patch, of full scale.
    """

    counts: np.ndarray
    mae: np.ndarray
    largest: np.ndarray

    @property
    def std_dn(self) -> float:
        """Standard deviation in DN, of the differences in whole DN."""
        dn = np.arange(-MAX_DN, MAX_DN + 1)
        mean = np.average(dn, weights=self.counts)
        return float(np.sqrt(np.average((dn - mean) ** 2, weights=self.counts)))

    def share_beyond(self, dn: int) -> float:
        """Share of the pixels that differ by more than so many whole DN."""
        return 1 - float(self.counts[MAX_DN - dn : MAX_DN + dn + 1].sum() / self.counts.sum())

    def worst(self, count: int) -> list[int]:
        """The patches of the largest MAE, the worst first."""
        return [int(k) for k in np.argsort(-self.mae, kind="stable")[:count]]


def spread_of(
    float_session: ort.InferenceSession, int8_session: ort.InferenceSession, images: Iterable[np.ndarray]
) -> Spread:
    """Run both networks on images (1, 1, H, W) in [0, 1], one at a time."""
    counts, mae, largest = np.zeros(2 * MAX_DN + 1, np.int64), [], []
    for image in images:
        in_float, in_int8 = (np.clip(run(session, image), 0, 1) for session in (float_session, int8_session))
        difference = (in_int8 - in_float).ravel()
        counts += np.bincount(np.rint(difference * MAX_DN).astype(np.int64) + MAX_DN, minlength=len(counts))
        mae.append(float(np.abs(difference).mean()))
        largest.append(float(np.abs(difference).max()))
    return Spread(counts, np.array(mae), np.array(largest))
