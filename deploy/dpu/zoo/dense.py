"""Networks with a result for every pixel or box: Darknet's detectors, YOLOv5 and YOLOX, SSD, segmentation, ConvBEERS.

ConvBEERS is the paper's own network: never fitted, only predicted.
"""

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Tensor
from deploy.dpu.zoo.classification import basic


def yolo_v5(width: float, depth: float, side: int = 640, classes: int = 80) -> Network:
    """YOLOv5 release 6 (Ultralytics, models/yolov5*.yaml)."""
    b = Builder(side, side)
    deep, _, shallow, middle = csp_body(b, b.conv(b.image, int(64 * width), 6, 2), width, depth)
    count = max(round(3 * depth), 1)
    deep = spp(b, csp(b, deep, deep.channels, count), (5, 5, 5))
    return b.network(*(b.conv(x, 3 * (classes + 5), 1) for x in neck(b, deep, middle, shallow, count)))


def yolox(width: float, depth: float, side: int = 640, classes: int = 80) -> Network:
    """YOLOX (Ge et al. 2021, arXiv:2107.08430, and its repository): decoupled heads, Focus stem."""
    b = Builder(side, side)
    deep, _, shallow, middle = csp_body(b, b.conv(b.unshuffle(b.image), int(64 * width)), width, depth)
    count = max(round(3 * depth), 1)
    deep = csp(b, spp(b, deep, (5, 9, 13)), deep.channels, count, skip=False)
    outputs = []
    for x in neck(b, deep, middle, shallow, count):
        x = b.conv(x, int(256 * width), 1)
        classed, boxed = (b.repeat(x, 2, lambda t: b.conv(t, t.channels)) for _ in range(2))
        outputs += [b.conv(classed, classes, 1), b.conv(boxed, 4, 1), b.conv(boxed, 1, 1)]
    return b.network(*outputs)


def csp(b: Builder, x: Tensor, channels: int, blocks: int, *, skip: bool = True) -> Tensor:
    """The C3 block of YOLOv5: half the channels through bottlenecks."""
    half = channels // 2
    y = b.conv(x, half, 1)
    for _ in range(blocks):
        z = b.conv(b.conv(y, half, 1), half)
        y = b.add(z, y) if skip else z
    return b.conv(b.concat(y, b.conv(x, half, 1)), channels, 1)


def csp_body(b: Builder, x: Tensor, width: float, depth: float) -> list[Tensor]:
    """Backbone and path aggregation neck that YOLOv5 and YOLOX share, from the result of stride 2 on."""
    wide = [int(c * width) for c in (128, 256, 512, 1024)]
    blocks = [max(round(n * depth), 1) for n in (3, 6, 9, 3)]
    stages: list[Tensor] = []
    for channels, count in zip(wide, blocks, strict=True):
        x = b.conv(x, channels, 3, 2)
        if channels == wide[-1]:
            return [x, *stages]
        x = csp(b, x, channels, count)
        stages.append(x)
    return stages


def spp(b: Builder, x: Tensor, kernels: tuple[int, ...]) -> Tensor:
    """Spatial pyramid pooling; equal kernels follow one another (SPPF), others stand side by side."""
    y = b.conv(x, x.channels // 2, 1)
    pools = [y]
    for kernel in kernels:
        pools.append(b.pool(pools[-1] if len(set(kernels)) == 1 else y, kernel, 1))
    return b.conv(b.concat(*pools), x.channels, 1)


def neck(b: Builder, deep: Tensor, middle: Tensor, shallow: Tensor, count: int) -> list[Tensor]:
    """Path aggregation: down to the finest stage and back; results of strides 8, 16 and 32."""
    wide = deep.channels
    top = b.conv(deep, wide // 2, 1)
    y = csp(b, b.concat(b.upsample(top), middle), wide // 2, count, skip=False)
    low = b.conv(y, wide // 4, 1)
    fine = csp(b, b.concat(b.upsample(low), shallow), wide // 4, count, skip=False)
    mid = csp(b, b.concat(b.conv(fine, wide // 4, 3, 2), low), wide // 2, count, skip=False)
    coarse = csp(b, b.concat(b.conv(mid, wide // 2, 3, 2), top), wide, count, skip=False)
    return [fine, mid, coarse]


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


def superpoint(height: int = 480, width: int = 640) -> Network:
    """SuperPoint (DeTone et al. 2017, arXiv:1712.07629, section 3)."""
    b = Builder(height, width, 1)
    x = b.image
    for index, channels in enumerate((64, 64, 128, 128)):
        x = b.pool(x, 2, 2) if index else x
        x = b.conv(b.conv(x, channels), channels)
    return b.network(b.conv(b.conv(x, 256), 65, 1), b.conv(b.conv(x, 256), 256, 1))


def erfnet(height: int = 512, width: int = 1024, classes: int = 20) -> Network:
    """ERFNet (Romera et al. 2018, IEEE T-ITS 19(1), table I)."""
    b = Builder(height, width)

    def down(x: Tensor, channels: int) -> Tensor:
        return b.concat(b.conv(x, channels - x.channels, 3, 2), b.pool(x, 2, 2))

    def factored(x: Tensor, dilation: int = 1) -> Tensor:
        y = b.conv(b.conv(x, x.channels, (3, 1)), x.channels, (1, 3))
        y = b.conv(b.conv(y, x.channels, (3, 1), dilation=dilation), x.channels, (1, 3), dilation=dilation)
        return b.add(y, x)

    x = down(down(b.image, 16), 64)
    x = down(b.repeat(x, 5, factored), 128)
    for dilation in (2, 4, 8, 16) * 2:
        x = factored(x, dilation)
    x = b.repeat(b.transposed(x, 64, 3, 2), 2, factored)
    x = b.repeat(b.transposed(x, 16, 3, 2), 2, factored)
    return b.network(b.transposed(x, classes, 2, 2))


def enet(height: int = 512, width: int = 1024, classes: int = 19) -> Network:
    """ENet (Paszke et al. 2016, arXiv:1606.02147, table 1), its unpooling replaced by nearest neighbour."""
    b = Builder(height, width)
    x = b.concat(b.conv(b.image, 13, 3, 2), b.pool(b.image, 2, 2))
    x = b.repeat(_enet_down(b, x, 64), 4, lambda t: _enet_block(b, t))
    x = _enet_down(b, x, 128)
    for dilation in (1, 2, 0, 4, 1, 8, 0, 16) * 2:  # 0: asymmetric
        x = _enet_block(b, x, dilation)
    x = b.repeat(_enet_up(b, x, 64), 2, lambda t: _enet_block(b, t))
    x = _enet_block(b, _enet_up(b, x, 16))
    return b.network(b.transposed(x, classes, 3, 2))


def _enet_block(b: Builder, x: Tensor, dilation: int = 1) -> Tensor:
    narrow = x.channels // 4
    y = b.conv(x, narrow, 1)
    middle = (
        b.conv(y, narrow, 3, dilation=dilation) if dilation else b.conv(b.conv(y, narrow, (5, 1)), narrow, (1, 5))
    )
    return b.add(b.conv(middle, x.channels, 1), x)


def _enet_down(b: Builder, x: Tensor, channels: int) -> Tensor:
    narrow = channels // 4
    y = b.conv(b.conv(b.conv(x, narrow, 2, 2), narrow), channels, 1)
    return b.add(y, b.conv(b.pool(x, 2, 2), channels, 1))


def _enet_up(b: Builder, x: Tensor, channels: int) -> Tensor:
    narrow = x.channels // 4
    y = b.conv(b.transposed(b.conv(x, narrow, 1), narrow, 3, 2), channels, 1)
    return b.add(y, b.upsample(b.conv(x, channels, 1)))


def convbeers(side: int = 640, blocks: int = 16, features: int = 64) -> Network:
    """ConvBEERS as the paper describes it: head, residual blocks, body's end, tail, global add."""
    b = Builder(side, side, 1)
    stream = head = b.conv(b.image, features)
    stream = b.repeat(stream, blocks, lambda x: b.add(b.conv(b.conv(x, features), features), x))
    deep = b.add(b.conv(stream, features), head)
    return b.network(b.add(b.conv(deep, 1), b.image))
