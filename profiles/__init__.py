"""The facts: what an instrument, a scene or a board is, and what a reported figure is.

It imports nothing of ours, and offers no names of its own, so that `--help` loads no NumPy.

- `sensor`, `scene_call`: sensors and scenes, each a pydantic model with its short TOML file;
  `sensor_file`: the tables of a sensor's file; `reference`: what a restoration aims at;
- `instrument`, `effects`, `response`: the physics: noise, effects, and a blur that is known by a
  table or a point-spread function; `point_spread_file`: the latter as a .npy file;
- `target`: processing boards, in `targets/`; `target_limits`: the numbers that one can have;
- `constant`: a number with its limits, status and source; `validation`: what pydantic finds wrong
  with a file, in one sentence; `toml`: how a file is read; `shipped`: the names of those here;
- `figures`: numbers with unit, mode and source; `errors`: what bad input becomes.
"""
