"""Object detection: drawn scenes with known objects, a detector small enough for a DPU, its training and its file.

- `objects` draws vehicles, ships, aircraft and tanks, `canvas` puts them on the ground, `scenes` makes whole scenes;
- `pictures` makes drawn scenes into the pictures that a detector reads, under the stretch of `model.io.pictures`;
- `network` is the detector, `targets` what it should say, `training` teaches it, `export` writes its file.
"""
