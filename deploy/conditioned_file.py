"""Condition an INT8 file that serves every sensor on the sensor of the images to restore.

`quantize` and `train --recipe` write such files for sensor-conditioned weights
(docs/how-to/train.md). As it is stored, the file is the network for the middle of the range of
sensors. Behind six sensors with an MTF of 7 % at Nyquist, it restored ten photographs 2 to 13 dB
worse than conditioned on them (measured).

`Network.load` returns the file as it is stored, because `gate` and `check` judge its own encoding.
They and `stress` also judge a damaged file, which is not run elsewhere.
"""

from dataclasses import replace

from beers_deploy.network import Network
from beers_deploy.network_files import UNKNOWN_SENSORS, ConditionedFile, warn_outside
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.encodings import SENSOR_BIASES, require_undamaged
from beers_deploy.quant.onnx_file import metadata


def to_run_on(network: Network, sensor: Sensor) -> Network:
    """Return the network that restores images of a sensor, as `conditioned_on` does.

    Args:
        network: any network.
        sensor: the sensor of the images.

    Raises:
        ModelError: the network is an INT8 file that was damaged after it was written.
    """
    require_undamaged(network.model, network.label)
    return conditioned_on(network, sensor)


def conditioned_on(network: Network, sensor: Sensor) -> Network:
    """Condition a network on the sensor of the images, if it is an INT8 file for every sensor.

    Args:
        network: any network.
        sensor: the sensor of the images.

    Returns:
        The INT8 network of the sensor, with its exposures. Any other network is returned unchanged,
        as is a file that was already conditioned on a sensor, and each file for an unknown sensor.
    """
    about = metadata(network.model)
    serves_every_sensor = SENSOR_BIASES in about and about.get("sensor", "") in UNKNOWN_SENSORS
    if sensor.name == BLIND or not serves_every_sensor:
        return network
    file = ConditionedFile(network.name, network.model)
    warn_outside(sensor, file.kernels)
    return replace(Network.for_sensor(file, sensor, int8=True), name=network.name)
