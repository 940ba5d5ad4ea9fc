"""Object detection: drawn scenes with known objects, a detector small enough for a DPU, its training and its file.

- `objects` draws vehicles, ships, aircraft and tanks, `canvas` puts them on the ground, `scenes` makes whole scenes;
- `display` turns digital numbers into the picture that a detector reads, `pictures` makes drawn ones;
- `network` is the detector, `targets` what it should say, `training` teaches it, `export` writes its file.
"""
