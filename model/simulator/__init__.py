"""The sensor simulator: from a scene's radiance to the digital numbers of an instrument.

- `sampling` reads scenes and samples them onto the sensor's grid, `procedural` draws one;
- `mtf` is the blur, in Fourier; `detector` what detectors and electronics do afterwards, noise
  among it;
- `plan` decides, with proven bounds, which optional effects a scene can show; `acquire` puts all in
  order.
"""
