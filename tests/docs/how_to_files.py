"""Small versions of the files that the how-to pages name, written by the program where possible."""

import re
import shutil
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from beers_deploy.kit.board import MEASURE
from beers_deploy.model.convbeers import save_network
from beers_deploy.model.shipped import SHIPPED
from beers_deploy.model.simulator.acquire import acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.profiles.shipped import HERE as PROFILES
from tests.deploy.studies.characterize.test_characterize import RATIO, SENSOR, landscape
from tests.deploy.studies.detection.folders import Object, dior
from tests.deploy.studies.detection.networks import detector, raw
from tests.docs.how_to import STARTED
from tests.docs.walk import Walk
from tests.model.networks import plain
from tests.model.raster import formats as images
from tests.project_files import ROOT, text_of

SITES = 6
SCENE_PX = 820
"""Number and side of the photographs, as `benchmarks/characterize.py` needs them."""
FEW = 2
FEW_PX = 480
COMMANDS = """
beers-deploy simulate --images scene.png --sensor pleiades-degraded --out made
beers-deploy export --network narrow.safetensors --out float.onnx
beers-deploy quantize float.onnx --images aerial --patch 32 --out int8.onnx --board-file core.onnx
beers-deploy gate float.onnx int8.onnx --patches 4 --json gate-main.json
"""


def prepare(folder: Path) -> None:
    """Write the files into a folder."""
    copied_files(folder)
    scenes(folder)
    faulty_frames(folder)
    networks(folder)
    labelled_pictures(folder)
    other_formats(folder)
    walk = Walk(folder, started=STARTED)
    for command in COMMANDS.split("\n")[1:-1]:
        process = walk.run(command)
        assert process.returncode == 0, f"{command}\n{process.stdout}"
    shutil.copy(next((folder / "made" / "degraded").glob("*.tif")), folder / "raw.tif")


def copied_files(folder: Path) -> None:
    """Copy files of this project, and write the files that the pages show."""
    shutil.copytree(
        ROOT / "benchmarks", folder / "benchmarks", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy(MEASURE, folder / "measure.py")
    shutil.copy(PROFILES / "sensors" / "pleiades-degraded.toml", folder / "my-sensor.toml")
    shutil.copy(SHIPPED / "convbeers-s.safetensors", folder)
    (folder / "gate.toml").write_text(
        shown("gate.md", r"```toml\n(# gate\.toml\n.*?)```"), encoding="utf-8"
    )
    (folder / "board.json").write_text(shown("board.md", r"^    (\[\{.*\}\])$"), encoding="utf-8")


def shown(page: str, pattern: str) -> str:
    """Return the only part of a page that matches a pattern."""
    (part,) = re.findall(pattern, text_of(f"docs/how-to/{page}"), re.DOTALL | re.MULTILINE)
    return str(part)


def scenes(folder: Path) -> None:
    """Write drawn photographs of roofs and yards, and two raw images of a sensor.

    The first raw image contains a checkerboard.
    """
    for name in ("aerial", "aerial-train"):
        (folder / name).mkdir()
    for site in range(SITES):
        random = np.random.default_rng(site)
        scene = np.full((SCENE_PX, SCENE_PX), 90, np.uint8)
        for _ in range(60):
            top, left, height, width = random.integers((0, 0, 20, 20), (800, 800, 160, 160))
            scene[top : top + height, left : left + width] = random.integers(40, 230)
        Image.fromarray(scene).save(folder / "aerial-train" / f"site{site}.png")
        if site < FEW:
            Image.fromarray(scene[:FEW_PX, :FEW_PX]).save(folder / "aerial" / f"site{site}.png")
    shutil.copy(folder / "aerial" / "site0.png", folder / "scene.png")
    for number in (1, 2):
        seed = number - 1
        ground = prepare_scene(landscape(seed, board=number == 1), RATIO)
        signal = acquire(ground, SENSOR, Draw(seed))
        tifffile.imwrite(folder / f"raw{number}.tif", to_uint16(signal))


def faulty_frames(folder: Path) -> None:
    """Write two frames of a camera with a dead column and a hot pixel."""
    for seed, name in enumerate(("frame.tif", "next.tif")):
        frame = np.rint(np.random.default_rng(seed).normal(600, 5, (90, 110)))
        frame[:, 40] = 0
        frame[20, 80] = 4095
        tifffile.imwrite(folder / name, frame.astype(np.uint16))


def networks(folder: Path) -> None:
    """Write weights of a narrow network, and a detector that always finds the same object."""
    save_network(folder / "narrow.safetensors", plain(), {"degraded": "pleiades-degraded"})
    detector(folder / "yolo11n.onnx", raw((30, 20, 20, 10, 0.1, 0.9)))


def labelled_pictures(folder: Path) -> None:
    """Write two images in the folder layout of DIOR."""
    boxes: list[Object] = [("ship", 4, 4, 20, 12), ("storagetank", 30, 10, 50, 30)]
    dior(folder / "DIOR", {"test": {"00001": boxes, "00002": boxes[:1]}})


def other_formats(folder: Path) -> None:
    """Write images in formats that GDAL reads."""
    pixels = images.digital_numbers(bands=1)
    images.write_jp2(folder / "raw.jp2", pixels, NBITS=12)
    images.write_vrt(folder / "mosaic.vrt", pixels)
    images.write_dimap(folder / "DIM_product.XML", pixels)
    images.write_tiff(folder / "bands.tif")
