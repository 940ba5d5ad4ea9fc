"""Compare an image with the sensor that is named for it, by its own pixels alone.

- `check`: noise and blur of windows spread over the image compared with the profile, and the
  warnings of `restore`; without a named sensor, the warning that the image looks restored already
- `comparison`: the two comparisons, each with its decision and its sentence
"""
