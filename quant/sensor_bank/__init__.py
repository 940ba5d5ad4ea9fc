"""INT8 networks whose first layer is the filter bank of a sensor, quantised once for every sensor.

A bank is the set of filters that `model.bank` computes in closed form from the blur and noise of
one sensor. The layers behind it, called the body, are the same for every sensor.

- `filters`: the integer bank, computed from a sensor alone;
- `conditioned`: a core that is conditioned on any sensor, and the difference between two sensors'
  files;
- `calibrate`: calibration of the layers behind a bank, over a range of sensors.
"""
