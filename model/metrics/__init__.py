"""Instruments: what an image is worth beside its reference, and what it shows by itself.

- with a reference: `fidelity` (PSNR, SSIM), `perceptual` (LPIPS and DISTS);
- from an image of a target: `slanted_edge` (MTF of an edge drawn at a known angle);
- from raw images of a sensor: `instrument` (blur and noise), by `edge_blur` (MTF by many short
  edges, each fitted by `edge_fit`), `edge_curve` (a whole curve) and `noise_line` (the noise under
  texture, in `noise_blocks`); they refuse (`refusal`) rather than guess;
- faults of single detectors: `detector_lines` and `detector_stripes`, `detector_phases`,
  `detector_pixels`;
- `bootstrap` says how far a mean over images can be trusted.
"""
