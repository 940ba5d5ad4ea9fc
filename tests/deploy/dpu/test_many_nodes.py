"""Reading and checking takes a number of steps that is linear in the number of nodes, whatever way
it goes.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import onnx
import pytest

from beers_deploy.verbs.check import check
from benchmarks.check_nodes import KINDS, Chain, network

TraceFunction = Callable[[FrameType, str, Any], Any]

FEWEST = 60
"""Nodes: the number is doubled twice."""
QUADRATIC = 2.5
"""A linear step takes twice as many more for the second doubling as for the first, a quadratic one
four times.
"""


def steps(model: onnx.ModelProto, path: Path) -> int:
    """Count the instructions of Python that this package carries out; time would depend on the
    machine.
    """
    onnx.save_model(model, path)
    count = 0

    def step(_frame: FrameType, event: str, _argument: object) -> TraceFunction:
        nonlocal count
        count += event == "opcode"
        return step

    def called(frame: FrameType, _event: str, _argument: object) -> TraceFunction | None:
        if not str(frame.f_globals.get("__name__")).startswith("beers_deploy"):
            return None
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False
        return step

    before = sys.gettrace()
    sys.settrace(called)
    try:
        check(path)
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_steps_grow_with_the_nodes(kind: Callable[[Chain], None], tmp_path: Path) -> None:
    # The first call also counts what is read once a process.
    steps(network(kind, FEWEST), tmp_path / "a.onnx")
    few, more, most = (
        steps(network(kind, FEWEST * times), tmp_path / "a.onnx") for times in (1, 2, 4)
    )
    assert most - more < QUADRATIC * (more - few)
