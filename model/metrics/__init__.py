"""Measure the quality of an image against its reference, or from the image alone.

- with a reference: `fidelity` (PSNR, SSIM), `perceptual` (LPIPS and DISTS);
- from an image of a target: `slanted_edge` (MTF of an edge drawn at a known angle);
- from raw images of a sensor: `instrument` (blur and noise), by `edge_blur` (MTF by many short
  edges, each fitted by `edge_fit`), `edge_curve` (a whole curve, from edges of `edge_search`, by
  `uneven_edge` and `mtf_basis`) and `noise_line` (the noise under texture, in `noise_blocks`); they
  return a `refusal` rather than guess;
- faults of single detectors: `detector_lines` and `detector_stripes`, `detector_phases`,
  `detector_pixels`;
- `statistics` estimates the uncertainty of a mean over images, and spreads despite outliers.
"""
