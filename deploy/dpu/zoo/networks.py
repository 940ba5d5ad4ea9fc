"""The published networks by name, what the host does with their results, and their published rates.

Layers stand in the `.net` files beside this module (see `notation`), rates in `published.csv`. Rows of the published
tables that cannot be are left out:
mobilenetv1 pruned and "62 GOP" mobilenetv2 are slips of the operations alone (the name has the right count); the
super-resolution network `xilinxSR` on the VCK190 and yolov6m on the KV260 are faster than their DPU's peak.
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
