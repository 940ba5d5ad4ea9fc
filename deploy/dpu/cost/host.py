"""Count the work of the host for one image, and estimate its time where no rate is published.

The host copies the image in and the results out, and then has a task, such as finding the best of
classes. The rates of these are fitted constants (`model`). The time of nodes that the DPU refuses
and of the consistency step follows from the processor's published rates as an interval.
"""

import math
from collections.abc import Sequence
from itertools import chain
from typing import Literal, NamedTuple, get_args

import numpy as np

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.placement import Placement
from beers_deploy.dpu.cost.model import Array, Constants, Interval
from beers_deploy.dpu.graph import Operation
from beers_deploy.model.consistency.step import PRODUCTS_PER_PX

Task = Literal["copy", "argmax", "softmax", "sort", "image"]
"""The host's task with the results: it only reads them (copy), finds the best of classes (argmax,
softmax), ranks boxes or key points (sort), or converts them to pixels (image).
"""
TASKS = get_args(Task)

OPERATORS: dict[str, Task] = {
    "ArgMax": "argmax",
    "Softmax": "softmax",
    "NonMaxSuppression": "sort",
    "TopK": "sort",
}
"""The operators in a file that determine the task."""

BANDS = 4
"""Maximum number of bands of an image: red, green, blue and transparency or infrared."""


def host_work(bytes_in: float, bytes_out: float, values: float, task: Task) -> Array:
    """Count the work of a board's processor, the host, for one image.

    Args:
        bytes_in: bytes of the DPU's inputs.
        bytes_out: bytes of the DPU's results. They are not copied for the task "image", which
            converts them to pixels anyway.
        values: number of result values that the task reads.
        task: the host's task with the results.

    Returns:
        An array (7,): 1 for the image, bytes copied to the DPU, bytes copied from it, then the
        values read by argmax, softmax, sort and image, of which only the one of `task` is not 0.
    """
    copied_bytes = 0.0 if task == "image" else bytes_out
    return np.array([1.0, bytes_in, copied_bytes, *(values * (task == name) for name in TASKS[1:])])


COPIES = 3
"""Units of `host_work` that are copies: the image, its bytes in and its bytes out."""


def host_parts_s(units: Array, constants: Constants) -> Array:
    """Predict the time of the host for an image, on one core.

    Args:
        units: the work of n networks, (n, 7), each row as `host_work` returns it.
        constants: the constants of the board.

    Returns:
        Times in s, (n, 2): of copying the image and the results, and of the task.
    """
    times = units * constants.host_s_per_unit
    return np.stack([times[:, :COPIES].sum(axis=1), times[:, COPIES:].sum(axis=1)], axis=1)


def placed_work(placement: Placement, task: Task) -> Array:
    """Count the work of the host for one image, from the tensors that cross to and from the DPU.

    The task reads every value of the results. A task "sort" on the maps of YOLO reads only one
    score for each box.

    Args:
        placement: where each operation of the network runs.
        task: the host's task with the results.

    Returns:
        An array (7,) as `host_work` returns it.
    """
    onto_bytes, back_bytes = _crossing_bytes(placement)
    back = {cut.tensor for cut in placement.cuts if not cut.onto_dpu}
    channels = {
        node.op.out_shape[0]
        for node in placement.nodes
        if node.op.out_shape and not back.isdisjoint(node.op.outputs)
    }
    # Maps with different numbers of channels are read completely.
    count = channels.pop() if len(channels) == 1 else 1
    values: float = back_bytes
    # The host skips a box whose score is low. A network is taken for YOLO if all its results have
    # the same number of channels, a multiple of BOXES.
    if task == "sort" and count % BOXES == 0 and count >= LEAST_NUMBERS * BOXES:
        values *= BOXES / count
    return host_work(onto_bytes, back_bytes, values, task)


BOXES = 3
LEAST_NUMBERS = 6
"""The number of boxes of a pixel in the maps of YOLO 2 to 7, and the minimum of numbers for a box:
four of place and size, a score, and a class.
"""


def task_of(placement: Placement) -> Task:
    """Derive what the host does with the DPU's results from the operators after the DPU.

    Without an operator of OPERATORS, a single result of at most BANDS channels is taken for an
    image if the DPU returns at least as many bytes as it receives. Any other result is only
    copied.
    """
    for node in placement.nodes:
        if node.part == "host-back" and node.op.op_type in OPERATORS:
            return OPERATORS[node.op.op_type]
    read_names = set(chain.from_iterable(node.op.inputs for node in placement.nodes))
    shapes = [
        node.op.out_shape for node in placement.nodes if read_names.isdisjoint(node.op.outputs)
    ]
    is_image = len(shapes) == 1 and shapes[0] is not None and shapes[0][0] <= BANDS
    onto, back = _crossing_bytes(placement)
    return "image" if back >= onto and is_image else "copy"


def _crossing_bytes(placement: Placement) -> tuple[int, int]:
    """Return the bytes of one image that the host sends to the DPU, and those that it receives."""
    onto = sum(cut.size_bytes or 0 for cut in placement.cuts if cut.onto_dpu)
    return onto, sum(cut.size_bytes or 0 for cut in placement.cuts if not cut.onto_dpu)


FLOAT_BYTES = 4
"""The vendor's operators on the CPU work on float32 (Vitis-AI 3.0, xcompiler: fix2float in front of
them).
"""
INSTRUCTIONS = 20.0
"""Instructions of plain code for a value of a result: four loads, their weights, their sum and its
address (assumed).
"""
PRODUCT_INSTRUCTIONS = 2.0
"""Instructions of plain code for an operation: two loads, a product with its sum and a step of the
loop count as two operations (assumed).
"""


def refused_interval_s(operations: Sequence[Operation], dpu: Dpu) -> Interval:
    """Estimate the time that the host needs for the operations that the DPU refuses.

    The estimate is not fitted, because published rates do not separate such work. The shortest time
    follows from the processor's published rates: products as in an optimised library, and each
    number moved once. The longest time is that of plain code, number by number.

    Args:
        operations: the operations that the DPU refuses.
        dpu: the configuration, whose board states the processor.

    Returns:
        The shortest and the longest time in s, for one image on all cores together.
    """
    low_s = high_s = 0.0
    for op in operations:
        read_values = sum(math.prod(shape) for shape in op.in_shapes if shape is not None)
        moved_values = op.out_bytes + read_values + op.weight_bytes
        least_s, most_s = _plain_work_s(op.operations, moved_values, op.out_bytes, dpu)
        low_s += least_s
        high_s += most_s
    return low_s, high_s


def _plain_work_s(operations: float, moved_values: float, results: float, dpu: Dpu) -> Interval:
    """Return the shortest and the longest time of all cores together for float32 work: by a good
    library, and by plain code.
    """
    keys = ("clock_ghz", "product_flops_per_cycle", "moved_bytes_per_s", "decoding_mips_per_ghz")
    clock, products, bandwidth, decoding = (dpu.limit("cpu", key) for key in keys)
    moved_bytes = FLOAT_BYTES * moved_values
    # A good library is bound by its products or by the memory; plain code pays for both.
    least_s = max(operations / (1e9 * clock.high * products.high), moved_bytes / bandwidth.high)
    instructions = INSTRUCTIONS * results + PRODUCT_INSTRUCTIONS * operations
    most_s = instructions / (1e6 * decoding.low * clock.low) + moved_bytes / bandwidth.low
    cores = dpu.whole("cpu", "cores")
    return least_s / cores, most_s / cores


FLOAT_OPERATIONS = {"nearest": 1.0, "linear": 6.0, "cubic": 14.0, "Sigmoid": 20.0, "Tanh": 20.0}
"""Operations of the host for each value, by the interpolation of an enlargement (products of rows
and columns and their sums) or by the activation (a hyperbolic tangent) (assumed).
"""


class FloatWork(NamedTuple):
    """The work of the host in float on an INT8 network's results, for which no rate is published.

    Attributes:
        kinds: keys of FLOAT_OPERATIONS.
        copies: the number of bytes that the DPU returns for each value.
    """

    kinds: tuple[str, ...] = ()
    copies: int = 1


def float_interval_s(placement: Placement, task: Task, work: FloatWork, dpu: Dpu) -> Interval:
    """Estimate the time in which the host enlarges an image or activates a result in float.

    Args:
        placement: where each operation of the network runs. A float file has the operators in it.
        task: the host's task with the results.
        work: the work of the host in float around an INT8 network.
        dpu: the configuration, whose board states the processor.

    Returns:
        The shortest and the longest time in s, for one image on all cores together.
    """
    _, back = _crossing_bytes(placement)
    values = [(kind, back / work.copies) for kind in work.kinds]
    for node in placement.nodes:
        if task == "image" and node.part != "dpu-core":
            kind = node.op.op_type
            if kind == "Resize":
                kind = str(node.op.attributes.get("mode", "nearest"))
            if kind in FLOAT_OPERATIONS:
                values.append((kind, node.op.out_bytes))
    operations = sum(FLOAT_OPERATIONS[kind] * count for kind, count in values)
    results = sum(count for _, count in values)
    return _plain_work_s(operations, 2 * results, results, dpu)


def consistency_interval_s(pixels: float, dpu: Dpu) -> Interval:
    """Estimate the time that the host needs for the consistency step, after the network.

    The step makes block means of the result agree with the raw image. The estimate is not fitted:
    the raw and the restored image are read, the result is written, and all other numbers stay in
    the caches.

    Args:
        pixels: number of pixels that the step is computed for.
        dpu: the configuration, whose board states the processor.

    Returns:
        The shortest and the longest time in s, on all cores together.
    """
    # A product with its sum counts as two operations.
    return _plain_work_s(2 * PRODUCTS_PER_PX * pixels, 3 * pixels, pixels, dpu)
