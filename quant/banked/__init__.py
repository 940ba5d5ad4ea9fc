"""A network behind the bank of its sensor (`model.bank`) in whole numbers, once for every sensor.

- `filters`: the bank's integers, written from a sensor alone;
- `family`: a network told a sensor, and what a sensor changes in its file;
- `calibrate`: the body behind a bank, calibrated over the family of sensors.
"""
