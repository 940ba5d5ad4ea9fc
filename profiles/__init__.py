"""The facts: what an instrument, a scene or a board is, and what a reported figure is. It imports nothing of ours.

- `sensor`, `effects`, `scene_call`: instruments and scenes, short TOML files that `sensor_file` reads;
- `response`: a blur known by a table or a point-spread function, which `response_file` reads;
- `target`: processing boards, in `targets/`;
- `constant`, `toml`: how such a file is read and checked, each number with its status and source;
- `figures`: numbers with unit, mode and source; `errors`: what bad input becomes.
"""

from beers_deploy.profiles.errors import BeersError
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.profiles.scene_call import SceneCall, load_scene_call, scene_names
from beers_deploy.profiles.sensor import Instrument, Sensor
from beers_deploy.profiles.sensor_file import load_sensor, sensor_names
from beers_deploy.profiles.target import TargetProfile, load_target, target_names

__all__ = [
    "BeersError",
    "Figure",
    "Instrument",
    "Row",
    "SceneCall",
    "Sensor",
    "TargetProfile",
    "load_scene_call",
    "load_sensor",
    "load_target",
    "scene_names",
    "sensor_names",
    "target_names",
]
