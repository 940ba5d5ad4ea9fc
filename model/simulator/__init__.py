"""Simulate a sensor: from a scene's radiance to the digital numbers of an instrument.

- `sampling` reads scenes and samples them onto the sensor's grid; `procedural` draws a scene, and
  `chart` a chart;
- `mtf` is the blur, in Fourier space; `detector` simulates detectors and electronics, including
  noise;
- `plan` decides, with proven bounds, which optional effects a scene can show; `acquire` runs all of
  them in order.
"""
