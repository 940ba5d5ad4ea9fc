"""What the host does with an image beside the DPU: it scales it, hands it over, and works on the results.

The task is what the timed run of a published rate does, and what `predict` finds behind a network's last convolution.
"""

from typing import Literal, get_args

import numpy as np

from deploy.dpu.checker.placement import Placement
from deploy.dpu.cost.constants import Array

Task = Literal["copy", "argmax", "softmax", "sort", "image"]
"""copy: results are read and no more; argmax or softmax over classes; sort: boxes or key points are ranked; image: a
result becomes pixels."""
TASKS = get_args(Task)

OPERATORS: dict[str, Task] = {
    "ArgMax": "argmax",
    "Softmax": "softmax",
    "NonMaxSuppression": "sort",
    "TopK": "sort",
}
"""What tells the task in a file."""


def host_work(bytes_in: float, bytes_out: float, values: float, task: Task) -> Array:
    """Units of the host's work for one image, (7,): 1, bytes in, bytes out, values of each task but copying.

    An image needs no other reading of its bytes than becoming pixels.
    """
    taken = 0.0 if task == "image" else bytes_out
    return np.array([1.0, bytes_in, taken, *(values * (task == name) for name in TASKS[1:])])


def crossing_bytes(placement: Placement) -> tuple[int, int]:
    """Bytes of one image that the host hands to the DPU, and takes back."""
    onto = sum(cut.size_bytes or 0 for cut in placement.cuts if cut.onto_dpu)
    back = sum(cut.size_bytes or 0 for cut in placement.cuts if not cut.onto_dpu)
    return onto, back


BANDS = 4
"""Most that an image has: red, green, blue and transparency or infrared."""


def task_of(placement: Placement) -> Task:
    """What a file tells of the host; one result of few bands, no smaller than the image, becomes an image."""
    behind = [node.op.op_type for node in placement.nodes if node.part == "host-back"]
    found = next((OPERATORS[name] for name in behind if name in OPERATORS), None)
    onto, back = crossing_bytes(placement)
    return found or ("image" if back >= onto and _gives_an_image(placement) else "copy")


def _gives_an_image(placement: Placement) -> bool:
    read = {name for node in placement.nodes for name in node.op.inputs}
    shapes = [node.op.out_shape for node in placement.nodes if read.isdisjoint(node.op.outputs)]
    return len(shapes) == 1 and shapes[0] is not None and shapes[0][0] <= BANDS


def placed_work(placement: Placement, task: Task) -> Array:
    """Units of the host's work for a network of a file, (7,): the task takes every value of the results."""
    onto, back = crossing_bytes(placement)
    return host_work(onto, back, back, task)


def frame_rate(dpu_s: float, host_s: float, crowding: float) -> float:
    """Images a second, from the time that the DPU and the host's cores take for one image."""
    longer, shorter = max(dpu_s, host_s), min(dpu_s, host_s)
    return float(1 / (longer * (1 + (shorter / longer) ** crowding) ** (1 / crowding)))
