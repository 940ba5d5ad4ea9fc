"""The float/INT8 gate: what INT8 changes, and whether that is too much."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import onnxruntime as ort

from model.metrics.fidelity import psnr_db
from quant.session import run


@dataclass(frozen=True)
class GateResult:
    """Differences in [0, 1] of full scale over all pixels; PSNRs over full scale, in dB."""

    mae: float
    std: float
    max_abs: float
    p999: float
    psnr_between_db: float
    psnr_degraded_db: float
    psnr_float_db: float
    psnr_int8_db: float
    patches: int

    @property
    def drop_db(self) -> float:
        """PSNR lost against the reference."""
        return self.psnr_float_db - self.psnr_int8_db

    @property
    def std_over_mae(self) -> float:
        """1.25 for rounding, which is Gaussian in the end; clipping drives it up. 0 where nothing differs."""
        return 0.0 if self.mae == 0 else self.std / self.mae


def compare(
    float_session: ort.InferenceSession,
    int8_session: ort.InferenceSession,
    pairs: Iterable[tuple[np.ndarray, np.ndarray]],
) -> GateResult:
    """Run both networks on (degraded, reference) pairs of (1, 1, H, W) in [0, 1]; outputs clipped as a file would."""
    differences, errors = [], []
    for degraded, reference in pairs:
        in_float, in_int8 = (_as_in_a_file(run(s, degraded)) for s in (float_session, int8_session))
        differences.append((in_int8 - in_float).ravel())
        errors.append([psnr_db(image, reference, 1.0) for image in (degraded, in_float, in_int8)])
    difference = np.concatenate(differences).astype(np.float64)
    degraded_db, float_db, int8_db = np.mean(errors, axis=0)
    return GateResult(
        mae=float(np.abs(difference).mean()),
        std=float(difference.std()),
        max_abs=float(np.abs(difference).max()),
        p999=float(np.quantile(np.abs(difference), 0.999)),
        psnr_between_db=psnr_db(difference, np.zeros_like(difference), 1.0),
        psnr_degraded_db=float(degraded_db),
        psnr_float_db=float(float_db),
        psnr_int8_db=float(int8_db),
        patches=len(errors),
    )


def _as_in_a_file(restored: np.ndarray) -> np.ndarray:
    """Clipped to [0, 1]; NaN where infinite, which no clipping makes a pixel."""
    return np.where(np.isinf(restored), np.nan, np.clip(restored, 0, 1))
