"""Darknet's detectors and the SSD of MLPerf."""

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Tensor
from deploy.dpu.zoo.classification import basic


def yolo_v2(side: int = 448, classes: int = 20) -> Network:
    """YOLOv2 (Redmon and Farhadi 2016, arXiv:1612.08242; darknet, yolov2-voc.cfg)."""
    b = Builder(side, side)
    x = b.pool(b.conv(b.image, 32), 2, 2)
    x = b.pool(b.conv(x, 64), 2, 2)
    for channels in (128, 256):
        x = b.pool(b.conv(b.conv(b.conv(x, channels), channels // 2, 1), channels), 2, 2)
    for channels in (512, 1024):
        passed = x
        x = b.conv(b.pool(x, 2, 2) if channels == 1024 else x, channels)
        for _ in range(2):
            x = b.conv(b.conv(x, channels // 2, 1), channels)
    x = b.conv(b.conv(x, 1024), 1024)
    x = b.concat(b.unshuffle(b.conv(passed, 64, 1)), x)
    return b.network(b.conv(b.conv(x, 1024), 5 * (classes + 5), 1))


def yolo_v3(height: int = 416, width: int = 416, classes: int = 20) -> Network:
    """YOLOv3 (Redmon and Farhadi 2018, arXiv:1804.02767; darknet, yolov3.cfg)."""
    b = Builder(height, width)
    x, stages = b.conv(b.image, 32), []
    for channels, blocks in zip((64, 128, 256, 512, 1024), (1, 2, 8, 8, 4), strict=True):
        x = b.conv(x, channels, 3, 2)
        x = b.repeat(x, blocks, lambda t: b.add(b.conv(b.conv(t, t.channels // 2, 1), t.channels), t))
        stages.append(x)
    outputs: list[Tensor] = []
    narrow = x
    for channels, stage in zip((512, 256, 128), reversed(stages[2:]), strict=True):
        x = stage if channels == 512 else b.concat(b.upsample(b.conv(narrow, channels, 1)), stage)
        for _ in range(2):
            x = b.conv(b.conv(x, channels, 1), 2 * channels)
        narrow = b.conv(x, channels, 1)
        outputs.append(b.conv(b.conv(narrow, 2 * channels), 3 * (classes + 5), 1))
    return b.network(*outputs)


def tiny_yolo_v3(side: int = 416, classes: int = 80) -> Network:
    """Tiny YOLOv3 (darknet, yolov3-tiny.cfg)."""
    b = Builder(side, side)
    x = b.image
    for channels in (16, 32, 64, 128):
        x = b.pool(b.conv(x, channels), 2, 2)
    middle = b.conv(x, 256)
    x = b.pool(b.conv(b.pool(middle, 2, 2), 512), 2, 1)
    x = b.conv(b.conv(x, 1024), 256, 1)
    large = b.conv(b.conv(x, 512), 3 * (classes + 5), 1)
    x = b.concat(b.upsample(b.conv(x, 128, 1)), middle)
    return b.network(large, b.conv(b.conv(x, 256), 3 * (classes + 5), 1))


def ssd_resnet34(side: int = 1200, classes: int = 81) -> Network:
    """SSD-ResNet-34 of MLPerf inference (single_stage_detector, 1200 x 1200)."""
    b = Builder(side, side)
    x = b.pool(b.conv(b.image, 64, 7, 2), 3, 2)
    for channels, count, stride in ((64, 3, 1), (128, 4, 2), (256, 6, 1)):
        for block in range(count):
            x = basic(b, x, channels, 1 if block else stride)
    maps = [x]
    for narrow, wide, stride in ((256, 512, 2), (256, 512, 2), (128, 256, 2), (128, 256, 2), (128, 256, 1)):
        x = b.conv(b.conv(x, narrow, 1), wide, 3, stride)
        maps.append(x)
    heads = zip(maps, (4, 6, 6, 6, 4, 4), (3, 3, 2, 2, 1, 1), strict=True)
    return b.network(*(b.conv(t, boxes * (4 + classes), 3, stride) for t, boxes, stride in heads))
