"""What the board's processor takes for operations that the DPU refuses.

None of it is fitted: no published rate tells such work apart. The least is what the processor's published rates
allow, products as a good library does them and every number moved once; the most is plain code, number by number. The
two are far apart, and so is what is said of a network with much of such work.
"""

import math
from collections.abc import Sequence

from deploy.dpu.board import Dpu
from deploy.dpu.graph import Operation

FLOAT_BYTES = 4
"""The vendor's operators on the CPU work on float32 (Vitis-AI 3.0, xcompiler: fix2float in front of them)."""

INSTRUCTIONS = 20.0
"""Of plain code for a value of a result: four loads, their weights, their sum and its address (assumed)."""
PRODUCT_INSTRUCTIONS = 2.0
"""Of plain code for an operation: two loads, a product with its sum and a step of the loop count as two (assumed)."""

Interval = tuple[float, float]


def processor_s(operations: Sequence[Operation], dpu: Dpu) -> Interval:
    """Time of one image on all cores together, least and most, in s; (0, 0) of nothing.

    Raises:
        ProfileError: the target states no processor.
    """
    if not operations:
        return 0.0, 0.0
    times = [_core_s(op, dpu) for op in operations]
    cores = dpu.whole("cpu", "cores")
    return math.fsum(low for low, _ in times) / cores, math.fsum(high for _, high in times) / cores


def between(interval: Interval) -> float:
    """The geometric mean: the ends are factors apart."""
    return math.sqrt(interval[0] * interval[1])


def _core_s(op: Operation, dpu: Dpu) -> Interval:
    """One operation on one core."""
    clock, products, moved, decoding = (
        dpu.limit("cpu", key)
        for key in ("clock_ghz", "product_flops_per_cycle", "moved_bytes_per_s", "decoding_mips_per_ghz")
    )
    floats = FLOAT_BYTES * (_values(op) + op.weight_bytes)
    least_s = max(op.operations / (1e9 * clock.high * products.high), floats / moved.high)
    instructions = INSTRUCTIONS * op.out_bytes + PRODUCT_INSTRUCTIONS * op.operations
    most_s = instructions / (1e6 * decoding.low * clock.low) + floats / moved.low
    return least_s, most_s


def _values(op: Operation) -> int:
    """Numbers read and written."""
    read = sum(math.prod(shape) for shape in op.in_shapes if shape is not None)
    return read + op.out_bytes
