"""Count the work of the DPU's parts for one image, operation by operation, from shapes alone."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.finding import groups_of
from beers_deploy.dpu.graph import Operation, Shape
from beers_deploy.profiles.rounding import up_to_multiple

FUSED = ("activation", "quantize", "dequantize", "pixel shuffle")
"""Kinds that cost no time: they are computed while the operation before writes its results, and a
pixel shuffle only determines where these are written.
"""
UNSTARTED = ("add", "mul", "concat")
"""Kinds without a start of their own: they follow another operation, or only place its results."""
BURST_BYTES = 64
"""The bytes that the memory moves at a time, at least: eight beats of 64 bit DDR4, sixteen of 32
bit LPDDR4.
"""
AUGMENTATION = 2
"""The number of input channels that the array reads at a time from several columns, over
input_channel_parallel: up to 32 in the DPUCZDX8G and DPUCVDX8G, 64 in the DPUCV2DX8G (Vitis-AI
master, targets/*.prototxt).
"""
SHARING = 2
"""The maximum number of readers of a result that the DPU keeps; for more, it passes through
memory.
"""


@dataclass(frozen=True)
class Work:
    """The work of one operation for one image, counted from shapes.

    A map is a tensor between two operations.

    Attributes:
        name: the name of the ONNX node.
        kind: the kind of operation.
        operations: the int8 operations that the result needs.
        array_operations: the operations of the convolution array, including those of channels and
            pixels that only fill it up; 0 for work of another engine.
        lane_steps: the values that the element-wise engine reads, including those that only fill it
            up; 0 for work of the array.
        weight_bytes: the bytes of the weights, which each core loads once for a batch.
        load_map_bytes: the bytes of maps that are loaded from memory.
        store_map_bytes: the bytes of maps that are stored to memory.
        serial: True if the operation loads its maps only after the operation before, so that
            nothing hides the transfer.
    """

    name: str
    kind: str
    operations: int
    array_operations: int
    lane_steps: int
    weight_bytes: int
    load_map_bytes: int
    store_map_bytes: int
    serial: bool

    @property
    def array_use(self) -> float:
        """The share of the array's operations that the result needs, in [0, 1].

        The others are those of channels and pixels that only fill the array up. The share is 1 for
        work of another engine.
        """
        return self.operations / self.array_operations if self.array_operations else 1.0

    @property
    def map_bytes(self) -> int:
        """The bytes of maps that pass through memory for one image."""
        return self.load_map_bytes + self.store_map_bytes

    @property
    def launched(self) -> bool:
        """True if the operation is started by itself, which takes `Constants.layer_s`.

        Adds, multiplications and concats run with the operation before them.
        """
        return self.kind not in UNSTARTED


def count_work(operations: Sequence[Operation], dpu: Dpu) -> tuple[Work, ...]:
    """Count the work of operations that run in sequence on the DPU.

    Args:
        operations: the operations, in the order in which they are computed.
        dpu: the configuration. Its sizes determine how full the array is, and which maps fit the
            chip.

    Returns:
        One entry for each operation, except those of the kinds FUSED, which cost nothing.
    """
    operations = _past_fused(operations)
    flow = _Flow(operations, dpu)
    return tuple(
        Work(
            name=op.name,
            kind=op.kind,
            operations=op.operations,
            array_operations=_array_operations(op, dpu),
            lane_steps=_lane_steps(op, dpu),
            weight_bytes=op.weight_bytes,
            load_map_bytes=flow.load(op),
            store_map_bytes=flow.store(op),
            serial=flow.serial(op),
        )
        for op in operations
        if op.kind not in FUSED
    )


def _array_operations(op: Operation, dpu: Dpu) -> int:
    """Return the operations of the array, which fills up channels, rows and columns.

    A transposed convolution runs as one convolution for each phase of its stride, which gives one
    pixel of every block of the output. No zeros are multiplied.
    """
    if op.kind not in ("conv", "transposed") or op.out_shape is None:
        return 0
    strides = op.window.strides if op.kind == "transposed" else (1, 1)
    channels, *sides = op.out_shape
    # All phases have one kernel size. If the stride does not divide the kernel, it is filled up.
    height, width = map(groups_of, sides, strides)
    rows, columns = map(groups_of, op.kernel, strides)
    pixels = _positions(
        (channels, height, width),
        dpu.whole("array", "pixel_parallel"),
        dpu.whole("array", "column_parallel"),
    )
    # With few input channels the array takes in several columns of the window side by side
    # (channel augmentation).
    read = op.channels[0]
    together = min(max(AUGMENTATION * dpu.input_parallel // read, 1), columns)
    full, rest = divmod(columns, together)
    lanes = dpu.input_parallel * dpu.whole("array", "input_groups")
    row_inputs = full * up_to_multiple(together * read, lanes) + up_to_multiple(rest * read, lanes)
    inputs = math.prod(strides) * rows * row_inputs
    return 2 * inputs * up_to_multiple(channels, dpu.output_parallel) * pixels


def _lane_steps(op: Operation, dpu: Dpu) -> int:
    if op.kind not in ("depthwise", "pool", "add", "mul") or op.in_shape is None:
        return 0
    # A depthwise convolution with several results a channel passes over its map for each of them.
    passes = max(op.channels[1] // max(op.channels[0], 1), 1) if op.kind == "depthwise" else 1
    taps = op.kernel_area * passes
    channels = up_to_multiple(op.in_shape[0], dpu.whole("elementwise", "channels_per_cycle"))
    rows = min(dpu.whole("elementwise", "pixels_per_cycle"), dpu.whole("array", "pixel_parallel"))
    return taps * channels * _positions(op.out_shape, rows)


def _positions(shape: Shape | None, rows: int, columns: int = 1) -> int:
    """Return the number of output pixels, rounded up to the rows and columns that are computed at
    once.
    """
    return up_to_multiple(shape[1], rows) * up_to_multiple(shape[2], columns) if shape else 0


class _Flow:
    """The maps of a network that pass through memory, because the banks on the chip cannot hold
    them, too many operations read them, or a concat joins them.

    An add or mul is fused with the operation before it, which stores the result. If the maps do not
    fit on the chip, the other operand is loaded from memory, and nothing hides that transfer.

    The operands of a concat, and the map that a pixel shuffle moves, are stored interleaved with
    those of other operations, so that the channels of each pixel take whole bursts.
    """

    def __init__(self, operations: Sequence[Operation], dpu: Dpu) -> None:
        # A group of banks is read while another is written.
        groups = dpu.value("memory", "feature_map_groups") / 2
        self._bank_bytes = dpu.value("memory", "feature_map_bytes") * groups
        self._lanes = dpu.input_parallel
        self._writers: dict[str, Operation] = {}
        self._positions: dict[str, int] = {}
        self._readers = Counter[str]()
        self._shapes: dict[str, Shape | None] = {}
        # The number of contiguous channels of a pixel, by result.
        self._pieces: dict[str, int] = {}
        self._stored: set[str] = set()
        for position, op in enumerate(operations):
            if op.kind == "pixel shuffle" and op.in_shape and op.out_shape:
                self._pieces[op.inputs[0]] = min(op.in_shape[0], op.out_shape[0])
            if op.kind == "concat":
                fed = zip(op.inputs, op.in_shapes, strict=True)
                self._pieces |= {name: shape[0] for name, shape in fed if shape}
                self._stored.update(op.inputs)
            if op.kind not in FUSED:
                self._writers |= dict.fromkeys(op.outputs, op)
                self._positions |= dict.fromkeys(op.outputs, position)
                self._readers.update(op.inputs)
                self._shapes[op.output] = op.out_shape
        self._sums = {self._fused(op): op.output for op in operations if op.kind in ("add", "mul")}

    def serial(self, op: Operation) -> bool:
        """Return True if an operation adds or multiplies two maps that do not fit on the chip."""
        return (
            op.kind in ("add", "mul")
            and len(op.inputs) == 2
            and op.in_shapes[0] == op.in_shapes[1]
            and not self._fits(op.output)
        )

    def load(self, op: Operation) -> int:
        """Return the bytes that an operation reads from memory.

        An add is fused with the operation that writes one of its operands. That operand and the
        inputs of that operation are on the chip, so they are not read again.
        """
        # A concat computes nothing: its operands were stored at their places in the result.
        if op.kind == "concat":
            return 0
        # The operand was read before, or computed earlier. In both cases it is no longer on the
        # chip.
        if self.serial(op):
            return _size(op.out_shape)
        here = set[str]()
        if op.kind in ("add", "mul"):
            fused = self._fused(op)
            here.add(fused)
            if fused in self._writers:
                here.update(self._writers[fused].inputs)
        fed = zip(op.inputs, op.in_shapes, strict=True)
        return sum(_size(shape) for name, shape in fed if name not in here and self._leaves(name))

    def store(self, op: Operation) -> int:
        """Return the bytes that an operation writes to memory.

        A fused add counts 0, because the operation that it is fused with counts them.
        """
        if op.kind in UNSTARTED:
            return 0
        name = op.output
        # A sum that is fused writes in place of the operation before it.
        while name in self._sums and self._readers[name] == 1:
            name = self._sums[name]
        size = _size(op.out_shape)
        # The host reads the network's result, and does the pixel shuffle at its end.
        if not self._readers[name]:
            return size
        if name not in self._stored and not self._leaves(name):
            return 0
        piece = self._pieces.get(name)
        # Pieces lie apart in memory: each takes whole bursts.
        return size // piece * up_to_multiple(piece, BURST_BYTES) if piece else size

    def _fused(self, add: Operation) -> str:
        """Return the operand of an add that is computed last."""
        return max(add.inputs, key=lambda name: self._positions.get(name, -1))

    def _leaves(self, name: str) -> bool:
        """Return True if a map passes through memory on its way to its readers."""
        writer = self._writers.get(name)
        outside = writer is None or writer.kind == "concat"
        return outside or not self._fits(name) or self._readers[name] > SHARING

    def _fits(self, name: str) -> bool:
        shape = self._shapes.get(name)
        # In the banks, channels are filled up to the number of lanes.
        return (
            shape is None
            or up_to_multiple(shape[0], self._lanes) * shape[1] * shape[2] <= self._bank_bytes
        )


def _past_fused(operations: Sequence[Operation]) -> list[Operation]:
    """Return the operations with inputs that the operation before those of the kinds FUSED
    writes.
    """
    origins: dict[str, str] = {}
    resolved = []
    for op in operations:
        inputs = tuple(origins.get(name, name) for name in op.inputs)
        resolved.append(replace(op, inputs=inputs))
        if op.kind in FUSED:
            origins |= dict.fromkeys(op.outputs, inputs[0])
    return resolved


def _size(shape: Shape | None) -> int:
    return math.prod(shape) if shape else 0


def largest_map_bytes(operations: Sequence[Operation]) -> int:
    """Return the size as int8 in bytes, for one image, of the largest result in a network."""
    return max(op.out_bytes for op in operations if op.kind not in FUSED)
