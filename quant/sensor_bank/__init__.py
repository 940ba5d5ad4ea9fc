"""INT8 networks behind a sensor's filter bank (`model.bank`), quantised once for every sensor.

- `filters`: the integer bank, computed from a sensor alone;
- `conditioned`: a core that is conditioned on any sensor, and the difference between two sensors'
  files;
- `calibrate`: calibration of the layers behind a bank, over a range of sensors.
"""
