"""Instruments: what an image is worth beside its reference, and what it shows by itself.

- with a reference: `fidelity` (PSNR, SSIM), `perceptual` (LPIPS, DISTS; `backbones`, `backbone_files`);
- from the image alone: `sharpness` (slanted-edge MTF; `edges`, `plateaus`, `edge_spread`), `noise_level` (SNR;
  `windows`, `noise_line`), which refuse (`refusal`) rather than guess;
- `edge_target` draws an edge, `bootstrap` says how far a mean can be trusted.
"""
