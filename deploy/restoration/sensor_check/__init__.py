"""An image compared with the sensor that is named for it, by its own pixels alone.

- `windows`: windows spread over the image
- `check`: their noise and blur against the profile, and what `restore` warns of
- `comparison`: the two comparisons, each with its decision and its sentence
- `raw`: without a named sensor, the warning that the image looks restored already
"""
