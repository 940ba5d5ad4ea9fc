"""The samples on which a network is calibrated and judged.

- `patches`: images with their references, in memory or simulated each time they are read.
- `own`: a user's own samples, checked and cut to patches; `stored` reads them from files or arrays.
- `views`, `simulated`: patches that are drawn from scenes, sensors and light.
- `coverage`: the part of the sensor's range that samples cover.
"""
