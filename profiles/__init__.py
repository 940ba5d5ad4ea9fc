"""The facts: sensors and targets as short TOML files, and the frozen dataclasses that read and check them."""

from profiles.sensor import SensorProfile
from profiles.sensor_file import load_sensor, sensor_names
from profiles.target import TargetProfile, load_target, target_names

__all__ = ["SensorProfile", "TargetProfile", "load_sensor", "load_target", "sensor_names", "target_names"]
