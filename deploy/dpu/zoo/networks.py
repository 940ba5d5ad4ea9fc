"""The published networks by name, what the host does with their results, and their published rates.

Layers stand in the `.net` files beside this module (see `notation`), rates in `published.csv`: tables of AMD's model
zoo (github.com/Xilinx/Vitis-AI), each row with the release and the line, row or record that prints it. A rate
contains the host: images lie decoded in memory, then each thread runs mean and scale, DPU and post-processing for a
batch (src/vai_library/benchmark). How many threads `fps` took is not stated; `fps_single` took one.

What a host does follows from the post-processing in src/vai_library/xnnpp/src:

- softmax: exponentials of every class, then the best few (classification.cpp, ultrafast_postimp.cpp);
- argmax: the largest channel of every pixel (segmentation.cpp);
- sort: scores above a threshold, their boxes, then non-maximum suppression. YOLO reads one score a box and skips the
  rest (yolov3.cpp, yolovx.cpp), SSD every score of every class (tfssd_detector.cpp), DenseBox and RetinaFace every
  score (facedetect.cpp, retinaface_detector.cpp); the boxes of the few that pass are not counted;
- image: every value becomes a pixel of an image (rcan.cpp, medicalsegcell_imp.cpp);
- copy: every value is read once, little else (reid.cpp, facequality.cpp).

A row of the tables is left out: ResNet-152 on the KV260 in release 2.0 repeats the rates of ResNet-101. Where a table
prints another number of operations for the same rates, the `.net` file says so.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Written
from deploy.dpu.zoo.notation import Entry, read_library

FOLDER = Path(__file__).parent
LIBRARY = read_library(sorted(FOLDER.glob("*.net")))
NETWORKS: Mapping[str, Entry] = LIBRARY.networks


@dataclass(frozen=True)
class PublishedRate:
    """Frames a second that a document prints, host included."""

    network: str
    board: str
    configuration: str
    fps: float
    """With several threads."""
    fps_single: float | None
    """With one thread, None where it is not printed."""
    release: str
    source: str


def network(name: str) -> Network:
    """One of NETWORKS, without weights."""
    return written(name).network


def family(name: str) -> str:
    """Networks of one family resemble one another."""
    return NETWORKS[name].family


def read_bytes(name: str) -> int:
    """Bytes of the results of one image that the host reads."""
    return sum(written(name).read_bytes.values())


@cache
def written(name: str) -> Written:
    """One of NETWORKS, written down once."""
    return LIBRARY.write(name)


def published_rates() -> list[PublishedRate]:
    """The rows of `published.csv`."""
    with (FOLDER / "published.csv").open(encoding="utf-8", newline="") as file:
        return [_rate(row) for row in csv.DictReader(file)]


def _rate(row: Mapping[str, str]) -> PublishedRate:
    single = float(row["fps_single"]) if row["fps_single"] else None
    place = row["network"], row["board"], row["configuration"]
    return PublishedRate(*place, float(row["fps"]), single, row["release"], row["source"])


def convbeers(side: int = 640, blocks: int = 16, features: int = 64) -> Network:
    """ConvBEERS as its paper describes it: head, residual blocks, body's end, tail, global add.

    It is in no fit, only predicted, and written for any size.
    """
    b = Builder(side, side, 1)
    stream = head = b.conv(b.image, features)
    for _ in range(blocks):
        stream = b.add(b.conv(b.conv(stream, features), features), stream)
    deep = b.add(b.conv(stream, features), head)
    return b.written(b.add(b.conv(deep, 1), b.image)).network
