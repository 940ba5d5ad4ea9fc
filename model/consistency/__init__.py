"""Make a restored image consistent with the raw one.

- `step`: the consistency step, at low spatial frequencies;
- `detail`: its extension to finer detail, for MTF curves that networks were not trained on;
- `smooth`: reduces the noise that a network leaves in dark parts;
- `blocks`: means over blocks of pixels, and the interpolation between them.
"""
