"""YOLOv5 and YOLOX: stages of cross-stage partial blocks, a neck that goes down and up again."""

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Tensor


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
