"""Makes the shipped INT8 files anew: of a network behind a bank one for all sensors, of others one for each sensor.

    python docs/make/int8.py [convbeers-s ...]
    python docs/make/int8.py convbeers-half --finetune aerial/ [--steps 250]

The same bytes that a user's cache would hold: calibrated on drawn scenes. With --finetune the whole numbers of the
default sensor's file are trained on a folder of photographs, unless it is behind a bank. Minutes a file.
"""

import argparse
import shutil
from pathlib import Path

from deploy.networks import MADE_FROM, PATCH_PX, PATCHES, SEED, behind_bank, family_model, float_file, int8_file
from model.progress import steps
from model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_names
from profiles.sensor_file import BLIND, load_sensor
from quant.calibration import Calibration
from quant.onnx_file import load_onnx, metadata, save_onnx
from quant.passes.tune import Tuning
from quant.quantise import quantise_model, ticks

SENSORS = (SENSOR, BLIND)
DETECTION = ("dior-medium", "dior-high")
"""What `detect` runs on with nothing given, by the default network alone."""
STEPS = 250


def main() -> None:
    """Make them one by one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=shipped_names())
    parser.add_argument("--finetune", type=Path, metavar="IMAGES", help="photographs to train the whole numbers on")
    parser.add_argument("--steps", type=int, default=STEPS, help="of that training")
    arguments = parser.parse_args()
    for name in arguments.names:
        if network := behind_bank(Path(name)):
            shipped = SHIPPED / f"{name}{INT8}.onnx"
            save_onnx(family_model(network), shipped)
            print(shipped.name, flush=True)
        else:
            of_each_sensor(name, arguments.finetune, arguments.steps)


def of_each_sensor(name: str, images: Path | None, count: int) -> None:
    """The files of a network whose every layer knows its sensor."""
    for sensor in (*SENSORS, *(DETECTION if name == VARIANT else ())):
        shipped = SHIPPED / f"{name}{INT8}-{sensor}.onnx"
        shipped.unlink(missing_ok=True)
        shutil.copyfile(int8_file(Path(name), load_sensor(sensor), print), shipped)
        print(shipped.name, flush=True)
    if images:
        finetune(name, images, count)


def finetune(name: str, images: Path, count: int) -> None:
    """Put a trained file in the place of that of the default sensor."""
    shipped = SHIPPED / f"{name}{INT8}-{SENSOR}.onnx"
    network = load_onnx(float_file(Path(name), load_sensor(SENSOR)))
    calibration, photographs = (Calibration(SENSOR, place, PATCHES, PATCH_PX, SEED) for place in (None, images))
    about = calibration.about | {MADE_FROM: metadata(load_onnx(shipped))[MADE_FROM]}
    tuning = Tuning(photographs.for_tuning.pairs, count)
    with steps(f"training {shipped.name}", ticks(network, PATCHES) + count) as bar:
        made = quantise_model(network, calibration.drawn, about, bar.advance, tuning=tuning)
    save_onnx(made.host, shipped)


if __name__ == "__main__":
    main()
