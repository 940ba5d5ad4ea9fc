"""Makes the shipped INT8 files anew: each network for the default sensor and a blind one, the default one for more.

    python docs/make/int8.py [convbeers-s ...]

The same bytes that a user's cache would hold: calibrated on drawn scenes. Minutes a file.
"""

import shutil
import sys
from pathlib import Path

from deploy.networks import int8_file
from model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_names
from profiles.sensor_file import BLIND, load_sensor

SENSORS = (SENSOR, BLIND)
DETECTION = ("dior-medium", "dior-high")
"""What `detect` runs on with nothing given, by the default network alone."""


def main() -> None:
    """Make them one by one."""
    for name in sys.argv[1:] or shipped_names():
        for sensor in (*SENSORS, *(DETECTION if name == VARIANT else ())):
            shipped = SHIPPED / f"{name}{INT8}-{sensor}.onnx"
            shipped.unlink(missing_ok=True)
            shutil.copyfile(int8_file(Path(name), load_sensor(sensor), print), shipped)
            print(shipped.name, flush=True)


if __name__ == "__main__":
    main()
