"""The traditional chain as a list of operators, judged by the same rules as a network."""

from collections.abc import Iterator
from dataclasses import dataclass

from deploy.dpu.board import Dpu
from deploy.dpu.checker.operators import Broken, judge
from deploy.dpu.graph import Operation, Window
from deploy.dpu.reading import KINDS

ONE_PIXEL = Window()
PATCH_PX = 5
SPECTRUM = (1, 1, 512, 512)


@dataclass(frozen=True)
class Step:
    """An operator of the chain: what it does there, and the rules it breaks."""

    purpose: str
    op: Operation
    broken: tuple[Broken, ...]


def judge_traditional(dpu: Dpu) -> list[Step]:
    """Every operator of the chain (`model.traditional`, denoise first) against the rules of a DPU."""
    return [Step(purpose, op, judge(op, dpu, quantised=False)) for purpose, op in traditional_chain()]


def verdict(steps: list[Step]) -> str:
    """Why the chain stays on the CPU, counted from the rules' own verdicts."""
    refused = sum(bool(step.broken) for step in steps)
    longest = run = 0
    for step in steps:
        run = 0 if step.broken else run + 1
        longest = max(longest, run)
    return (
        f"the traditional chain stays on the CPU: the DPU refuses {refused} of its {len(steps)} operators, "
        f"and no more than {longest} in a row could stay on it"
    )


def traditional_chain() -> Iterator[tuple[str, Operation]]:
    """What each step of the chain computes, as the ONNX operator that a converter would choose."""
    from model.traditional.compensate import RADIUS_PX

    side = 2 * RADIUS_PX + 1
    yield "stabilise the noise: root of the signal", _step("Sqrt")
    yield "stabilise the noise: quotient", _step("Div")
    yield "patch distances: difference of shifted images", _step("Sub")
    yield "patch distances: square", _step("Mul")
    yield "patch distances: sum over the patch", _step("AveragePool", Window(kernel=(PATCH_PX, PATCH_PX)))
    yield "the nearest patches: partial sort", _step("TopK")
    yield "collect each group", _step("Gather")
    yield "mean patch of each group", _step("ReduceMean")
    yield "covariance of each group", _step("MatMul")
    yield "its factor", _step("Cholesky")
    yield "estimate of every patch: two triangular systems", _step("TriangularSolve")
    yield "add the estimates where they belong", _step("ScatterND")
    yield "mean of a pixel's estimates", _step("Div")
    yield "back to radiance: square", _step("Mul")
    yield "back to radiance: sum", _step("Add")
    yield "mirror the borders", _step("Pad", mode=b"reflect")
    yield "MTF compensation: spectrum", _step("DFT")
    yield "MTF compensation: times the transfer function", _step("Mul", constant_shape=SPECTRUM)
    yield "MTF compensation: back to an image", _step("DFT")
    yield f"or the same as a convolution of {side} x {side}", _step("Conv", Window(kernel=(side, side)))
    yield "clip to the full scale", _step("Clip")


def _step(
    op_type: str, window: Window = ONE_PIXEL, constant_shape: tuple[int, ...] | None = None, **attributes: object
) -> Operation:
    kind = KINDS.get(op_type, "other")
    return Operation(
        op_type,
        op_type,
        kind,
        ("image",),
        ("result",),
        window=window,
        channels=(1, 1),
        constant_shape=constant_shape,
        attributes=attributes,
    )
