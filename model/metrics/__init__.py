"""Instruments: what an image is worth beside its reference, and what it shows by itself.

- with a reference: `fidelity` (PSNR, SSIM), `perceptual` (LPIPS and DISTS);
- from an image of a target: `slanted_edge` (MTF of an edge drawn at a known angle);
- from raw images of a sensor, for its profile: `edge_blur` (MTF by many short edges) and `noise_line` (the noise
  under texture); they refuse (`refusal`) rather than guess;
- `bootstrap` says how far a mean over images can be trusted.

Offered here is what needs no torch, for the gate and the reports; the instruments are imported from their modules.
"""

from beers_deploy.model.metrics.bootstrap import site_interval
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.metrics.refusal import Refusal

__all__ = ["Refusal", "psnr_db", "site_interval", "ssim"]
