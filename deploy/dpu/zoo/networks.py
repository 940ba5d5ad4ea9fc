"""The networks that the cost model is fitted on, by name, and their published rates."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from deploy.dpu.graph import Network
from deploy.dpu.zoo.classification import (
    efficientnet_edgetpu,
    efficientnet_lite0,
    mobilenet_v1,
    mobilenet_v2,
    reid,
    resnet18,
    resnet_bottleneck,
    resnet_v2,
    sphereface20,
    squeezenet,
    vgg,
)
from deploy.dpu.zoo.dense import (
    enet,
    erfnet,
    ssd_resnet34,
    superpoint,
    tiny_yolo_v3,
    yolo_v2,
    yolo_v3,
    yolo_v5,
    yolox,
)
from deploy.dpu.zoo.inception import inception_resnet_v2, inception_v1, inception_v2, inception_v3

HostReads = Literal["all", "scores", "sorts"]
"""What the host does with the results: read every value (classes, pixels), read one score a box and skip the rest, or
sort boxes or key points of a dense map, which takes time that no count of bytes tells."""


@dataclass(frozen=True)
class Entry:
    """How to write a network down; networks of one family resemble one another."""

    family: str
    build: Callable[[], Network]
    host_reads: HostReads = "all"


NETWORKS = {
    "resnet-18": Entry("resnet", resnet18),
    "resnet-50": Entry("resnet", lambda: resnet_bottleneck(50, "first")),
    "resnet-50 v1.5": Entry("resnet", lambda: resnet_bottleneck(50, "middle")),
    "resnet-50 slim": Entry("resnet", lambda: resnet_bottleneck(50, "last block")),
    "resnet-101 slim": Entry("resnet", lambda: resnet_bottleneck(101, "last block")),
    "resnet-152 slim": Entry("resnet", lambda: resnet_bottleneck(152, "last block")),
    "resnet-18 persons": Entry("resnet", lambda: reid(18, 176, 80)),
    "resnet-50 persons": Entry("resnet", lambda: reid(50, 256, 128)),
    "resnet-50 v2": Entry("resnet v2", lambda: resnet_v2(50)),
    "resnet-101 v2": Entry("resnet v2", lambda: resnet_v2(101)),
    "resnet-152 v2": Entry("resnet v2", lambda: resnet_v2(152)),
    "sphereface-20": Entry("sphereface", sphereface20),
    "vgg-16": Entry("vgg", lambda: vgg(16)),
    "vgg-19": Entry("vgg", lambda: vgg(19)),
    "squeezenet 1.1": Entry("squeezenet", squeezenet),
    "mobilenet v1": Entry("mobilenet v1", mobilenet_v1),
    "mobilenet v1 0.5": Entry("mobilenet v1", lambda: mobilenet_v1(160, 0.5)),
    "mobilenet v1 0.25": Entry("mobilenet v1", lambda: mobilenet_v1(128, 0.25)),
    "mobilenet v2": Entry("mobilenet v2", mobilenet_v2),
    "mobilenet v2 1.4": Entry("mobilenet v2", lambda: mobilenet_v2(224, 1.4)),
    "efficientnet lite0": Entry("efficientnet", efficientnet_lite0),
    "efficientnet edgetpu s": Entry("efficientnet", lambda: efficientnet_edgetpu(224, 1.0, 1.0)),
    "efficientnet edgetpu m": Entry("efficientnet", lambda: efficientnet_edgetpu(240, 1.0, 1.1)),
    "efficientnet edgetpu l": Entry("efficientnet", lambda: efficientnet_edgetpu(300, 1.2, 1.4)),
    "inception v1": Entry("inception", inception_v1),
    "inception v1 slim": Entry("inception", lambda: inception_v1(large=3)),
    "inception v2": Entry("inception", inception_v2),
    "inception v2 slim": Entry("inception", lambda: inception_v2(separable_stem=True)),
    "inception v3": Entry("inception", inception_v3),
    "inception-resnet v2": Entry("inception", inception_resnet_v2),
    "yolo v2": Entry("darknet", yolo_v2, "scores"),
    "yolo v3": Entry("darknet", yolo_v3, "scores"),
    "yolo v3 coco": Entry("darknet", lambda: yolo_v3(classes=80), "scores"),
    "yolo v3 512 x 288": Entry("darknet", lambda: yolo_v3(288, 512, 10), "scores"),
    "tiny yolo v3": Entry("darknet", tiny_yolo_v3, "scores"),
    "yolo v5 n": Entry("csp", lambda: yolo_v5(0.25, 0.33), "scores"),
    "yolo v5 l": Entry("csp", lambda: yolo_v5(1.0, 1.0), "scores"),
    "yolox m": Entry("csp", lambda: yolox(0.75, 0.67), "scores"),
    "erfnet": Entry("erfnet", erfnet),
    "enet": Entry("enet", enet),
    "superpoint": Entry("superpoint", superpoint, "sorts"),
    "ssd-resnet-34": Entry("ssd", ssd_resnet34, "sorts"),
}


@dataclass(frozen=True)
class PublishedRate:
    """Frames a second that a document prints, end to end with several threads; the operations it states."""

    network: str
    configuration: str
    fps: float
    operations: float
    source: str


@cache
def network(name: str) -> Network:
    """One of NETWORKS, written down once."""
    return NETWORKS[name].build()


def published_rates() -> list[PublishedRate]:
    """The rows of `published.csv`."""
    with (Path(__file__).parent / "published.csv").open(encoding="utf-8", newline="") as file:
        return [
            PublishedRate(
                row["network"], row["configuration"], float(row["fps"]), 1e9 * float(row["gop"]), row["source"]
            )
            for row in csv.DictReader(file)
        ]
