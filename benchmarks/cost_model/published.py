"""Read the published networks and their published rates, as cases for the fit.

The layers are in the `.net` files under `zoo/` (see `notation`), the rates in `zoo/published.csv`.
They are from tables of AMD's model zoo (github.com/Xilinx/Vitis-AI), and each row states the
release and the line, row or record that prints it. A rate includes the host: decoded images are in
memory, and each thread runs mean and scale, DPU and post-processing for a batch
(src/vai_library/benchmark). The number of threads of `fps` is not stated; `fps_single` is of one.

The task of the host follows from the post-processing in src/vai_library/xnnpp/src:

- softmax: exponentials of every class, then the best few (classification.cpp,
  ultrafast_postimp.cpp);
- argmax: the largest channel of every pixel (segmentation.cpp);
- sort: scores above a threshold, their boxes, then non-maximum suppression. YOLO reads one score a
  box and skips the rest (yolov3.cpp, yolovx.cpp), SSD every score of every class
  (tfssd_detector.cpp), DenseBox and RetinaFace every score (facedetect.cpp,
  retinaface_detector.cpp); the boxes of the few that pass are not counted;
- image: every value becomes a pixel of an image (rcan.cpp, medicalsegcell_imp.cpp);
- copy: every value is read once, little else (reid.cpp, facequality.cpp).

A row of the tables is left out: ResNet-152 on the KV260 in release 2.0 repeats the rates of
ResNet-101. Where a table prints another number of operations for the same rates, the `.net` file
says so.
"""

import csv
import math
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from beers_deploy.dpu.board import Dpu, load_dpu
from beers_deploy.dpu.cost.host import host_work
from beers_deploy.dpu.cost.model import Array, Layers
from beers_deploy.dpu.cost.work import count_work, largest_map_bytes
from benchmarks.cost_model.builder import Written
from benchmarks.cost_model.notation import read_library

ZOO = Path(__file__).parent / "zoo"
LIBRARY = read_library(sorted(ZOO.glob("*.net")))
NETWORKS = LIBRARY.networks


@dataclass(frozen=True)
class Case:
    """A network on a configuration with its rates.

    Attributes:
        network: the name of the network.
        family: the family, whose networks resemble one another.
        configuration: the configuration of the DPU.
        layers: the work of its layers.
        host: units of the host's work for one image (7,), see `host_work`.
        host_cores: the number of cores of the board's processor.
        fps: rates with several threads, one or more.
        fps_single: rates with one thread, perhaps none.
        map_bytes: the size of its largest result.
    """

    network: str
    family: str
    configuration: str
    layers: Layers
    host: Array
    host_cores: int
    fps: tuple[float, ...]
    fps_single: tuple[float, ...]
    map_bytes: int


@cache
def written(name: str) -> Written:
    """Return the layers of one of NETWORKS."""
    return LIBRARY.write(name)


@cache
def published_rates() -> list[dict[str, str]]:
    """Return the rows of `published.csv`."""
    with (ZOO / "published.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


SLOWER = {"kv260": ("1.4", "2.0")}
"""Releases whose image moved maps more slowly on a board.

RCAN, SESR and ENet became 27 to 42 % faster with the next release, and 1 to 9 % on the ZCU102.
Boards are installed with later releases today, so the fit leaves these rates out.
"""


@cache
def boards() -> tuple[str, ...]:
    """Return the names of the boards with published rates."""
    return tuple(dict.fromkeys(rate["board"] for rate in published_rates()))


@cache
def host_cores(board: str) -> int:
    """Return the number of cores of a board's processor: four Cortex-A53 of the Zynq boards, two
    Cortex-A72 of the Versal boards.
    """
    return load_dpu(board).whole("cpu", "cores")


@cache
def published_cases(board: str) -> tuple[Case, ...]:
    """Return the published rates of a board, without those of its SLOWER releases; one case a
    network and configuration.
    """
    cases = defaultdict(list)
    for rate in published_rates():
        if rate["board"] == board and rate["release"] not in SLOWER.get(board, ()):
            cases[rate["network"], rate["configuration"]].append(rate)
    return tuple(
        network_case(
            name,
            load_dpu(board, configuration),
            tuple(float(rate["fps"]) for rate in rates),
            tuple(float(rate["fps_single"]) for rate in rates if rate["fps_single"]),
        )
        for (name, configuration), rates in cases.items()
    )


def network_case(
    name: str, dpu: Dpu, fps: tuple[float, ...], fps_single: tuple[float, ...] = ()
) -> Case:
    """Return one of NETWORKS on a configuration, with its rates."""
    net = written(name).network
    entry = NETWORKS[name]
    sizes = {op.output: op.out_bytes for op in net.operations}
    input_size = sum(math.prod(shape) for shape in net.inputs.values())
    weight_bytes = sum(written(name).read_bytes.values())
    output_size = sum(sizes[result] for result in net.outputs)
    sizes_read = (input_size, output_size, weight_bytes) if entry.host else (0, 0, 0)
    host = host_work(*sizes_read, entry.host or "copy")
    layers = Layers.of(count_work(net.operations, dpu), dpu)
    cores = dpu.whole("cpu", "cores")
    largest = largest_map_bytes(net.operations)
    return Case(name, entry.family, dpu.name, layers, host, cores, fps, fps_single, largest)
