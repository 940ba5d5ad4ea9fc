"""The facts: descriptions of instruments, scenes and boards, and reported figures.

It imports nothing of this project, and exports no names itself, so that `--help` does not load
NumPy.

- `sensor`, `scene_call`: sensors and scenes, each a pydantic model with its short TOML file;
  `sensor_file`: the tables of a sensor's file; `sensor_checks`: that one instrument can have its
  numbers; `reference`: the sensor that a restoration aims at;
- `instrument`, `effects`, `response`: the physics: noise, effects, and a blur that is given by a
  table or a point-spread function; `point_spread_file`: a point-spread function as a .npy file;
- `target`: processing boards, in `targets/`; `target_limits`: the valid numbers of a board;
- `constant`: a number with its limits, status and source; `validation`: pydantic's errors in one
  sentence; `toml`: reading of a profile, `user_files` of other files; `shipped`: the names of the
  shipped profiles; `rounding`: whole numbers;
- `figures`: numbers with unit, mode and source; `errors`: the exceptions for bad input.
"""
