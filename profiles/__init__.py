"""The facts: what an instrument, a scene or a board is, and what a reported figure is.

It imports nothing of ours, and offers no names of its own, so that `--help` loads no NumPy.

- `sensor`, `effects`, `scene_call`: instruments and scenes, short TOML files that `sensor_file`
  reads;
- `response`: a blur known by a table or a point-spread function;
- `target`: processing boards, in `targets/`;
- `constant`, `toml`: how such a file is read and checked, each number with its status and source;
- `figures`: numbers with unit, mode and source; `errors`: what bad input becomes.
"""
