"""How long a network takes on the DPU, layer by layer, and how far off that may be.

A layer's counts and its formula come from `layers.py`, the constants and errors from the target's [cost], where
`docs/make_cost_model.py` writes what `fit.py` finds on published networks. None of them is ConvBEERS: the paper's own
figure is what the model is compared with, never what it is made from.

The interval is FPS e^-error to FPS e^+error. `error_inside` is the 90 % quantile of |ln(predicted / published)| of
networks left out of the fit, each network counting once. Where a network lies outside the range of the fitted ones,
`error_outside` takes its place (networks with large maps, predicted from those with small ones), and the interval
starts from FPS with nothing hidden (serial = 1) and with everything hidden (serial = 0).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deploy.dpu.board import Dpu
from deploy.dpu.checker.placement import Placement
from deploy.dpu.cost.layers import FUSED, Constants, Layers, Work, count_work, host_s
from deploy.dpu.graph import Operation
from deploy.restoration.plan import plan_side
from profiles.errors import ModelError
from profiles.figures import Figure, predicted, unavailable


@dataclass(frozen=True)
class LayerCost:
    """What one operation costs for one batch; `work` counts one image."""

    work: Work
    compute_s: float
    memory_s: float
    time_s: float

    @property
    def start_s(self) -> float:
        """What is neither compute nor memory."""
        return max(self.time_s - self.compute_s - self.memory_s, 0.0)

    @property
    def bound(self) -> str:
        """What takes longest: compute, memory or overhead."""
        parts = {"compute": self.compute_s, "memory": self.memory_s, "overhead": self.start_s}
        return max(parts, key=lambda name: parts[name])


@dataclass(frozen=True)
class Profile:
    """What places a network inside or outside the range of the fitted ones."""

    operations: float
    map_bytes: float  # the largest result
    intensity: float  # operations per map byte moved

    @classmethod
    def of(cls, operations: Sequence[Operation], works: Sequence[Work]) -> "Profile":
        """The profile of a network, one image."""
        total = sum(work.operations for work in works)
        moved = sum(work.load_map_bytes + work.store_map_bytes for work in works)
        return cls(total, max(op.out_bytes for op in operations if op.kind not in FUSED), total / max(moved, 1))


@dataclass(frozen=True)
class Prediction:
    """What the model says of one network on one configuration; `note` says what was assumed of the file.

    `outside` names what lies beyond the fitted networks, and is empty where nothing does.
    """

    configuration: str
    batch: int
    layers: tuple[LayerCost, ...]
    overhead_s: float
    host_s: float
    fps_interval: tuple[float, float]
    outside: tuple[str, ...] = ()
    note: str = ""

    @cached_property
    def batch_time_s(self) -> float:
        """Time of one batch on the DPU: the layers and the overhead, nothing else."""
        return math.fsum([*(layer.time_s for layer in self.layers), self.overhead_s])

    @property
    def fps(self) -> float:
        """Images a second, batches back to back, the host working on others beside them."""
        return frame_rate(self.batch_time_s, self.batch, self.host_s)

    @property
    def operations(self) -> int:
        """int8 operations for one image."""
        return sum(layer.work.operations for layer in self.layers)

    @property
    def streamed_bytes(self) -> int:
        """Feature-map bytes that one image moves through memory."""
        return sum(layer.work.load_map_bytes + layer.work.store_map_bytes for layer in self.layers)


def frame_rate(batch_time_s: float, batch: int, host_time_s: float) -> float:
    """Images a second: the slower of the DPU and the host."""
    return 1 / max(batch_time_s / batch, host_time_s)


def predict(placement: Placement, dpu: Dpu) -> Prediction:
    """Predict a network that runs whole on the DPU.

    Raises:
        ModelError: a node that the DPU cannot run, or nothing for it to do.
    """
    if placement.failed:
        names = ", ".join(node.op.name for node in placement.failed[:3])
        remedy = "run 'beers-deploy check' for the reasons and remedies"
        raise ModelError("cost model", expected="a core that runs whole on the DPU", got=names, remedy=remedy)
    works = count_work(placement.core, dpu)
    if not any(work.operations for work in works):
        remedy = "give a network with convolutions"
        raise ModelError("cost model", expected="work for the DPU", got="no convolution", remedy=remedy)
    constants, serial = Constants.of(dpu), dpu.value("cost", "serial")
    layers = Layers.of(works, dpu)
    columns = (layers.compute_s(constants), layers.memory_s(constants), layers.time_s(constants, serial))
    costs = tuple(LayerCost(*row) for row in zip(works, *(c.tolist() for c in columns), strict=True))
    host_time_s = crossing_s(placement, constants)
    outside = _outside(Profile.of(placement.core, works), dpu)
    interval = _interval(layers, constants, host_time_s, dpu, bool(outside))
    return Prediction(dpu.name, dpu.batch, costs, constants.batch_s, host_time_s, interval, outside, placement.note)


def crossing_bytes(placement: Placement) -> tuple[int, int]:
    """Bytes of one image that the host hands to the DPU, and takes back."""
    onto = sum(cut.size_bytes or 0 for cut in placement.cuts if cut.onto_dpu)
    back = sum(cut.size_bytes or 0 for cut in placement.cuts if not cut.onto_dpu)
    return onto, back


def crossing_s(placement: Placement, constants: Constants) -> float:
    """Time of the host for one image: making planes, reading corrections, adding them."""
    taken, read = (np.array([size], float) for size in crossing_bytes(placement))
    return float(host_s(taken, read, constants)[0])


def _interval(
    layers: Layers, constants: Constants, host_time_s: float, dpu: Dpu, outside: bool
) -> tuple[float, float]:
    serial = dpu.value("cost", "serial")
    shares = (1.0, 0.0) if outside else (serial, serial)
    times_s = [math.fsum([*layers.time_s(constants, share).tolist(), constants.batch_s]) for share in shares]
    slow, fast = (frame_rate(time_s, dpu.batch, host_time_s) for time_s in times_s)
    spread = math.exp(dpu.value("cost", "error_outside" if outside else "error_inside"))
    return slow / spread, fast * spread


RANGES = {
    "map_bytes": ("largest map", 1e6, " MB"),
    "operations": ("work", 1e9, " GOP"),
    "intensity": ("operations per byte moved", 1.0, ""),
}


def _outside(profile: Profile, dpu: Dpu) -> tuple[str, ...]:
    """What of a network lies beyond the fitted ones, each with the end of the range that it passes."""
    found = []
    for key, (name, scale, unit) in RANGES.items():
        value, fitted = getattr(profile, key), dpu.limit("cost", f"fitted_{key}")
        if value > fitted.high:
            found.append(f"{name} {value / scale:.3g}{unit} (fitted up to {fitted.high / scale:.3g})")
        if value < fitted.low:
            found.append(f"{name} {value / scale:.3g}{unit} (fitted from {fitted.low / scale:.3g})")
    return tuple(found)


def paper_frames(width_px: int, height_px: int, tile_px: int) -> float:
    """Pixels of the image over pixels of a tile: a fraction, with no halo (paper, table of the VCK190 benchmark).

    13600 x 9016 at 640 is 299.4; at the published 7.2 frames a second that is the published 42 s.
    """
    return width_px * height_px / tile_px**2


def tile_count(size_px: int, tile_px: int, halo_px: int) -> int:
    """Tiles along one side, ceil((size - 2 halo) / (tile - 2 halo)): the outer tiles need no halo outside.

    Raises:
        OptionError: a tile with no room between its two halos.
    """
    return len(plan_side(size_px, tile_px, halo_px))


def whole_tiles(width_px: int, height_px: int, tile_px: int, halo_px: int) -> int:
    """Tiles of the grid, the last row and column moved inward: 384 for 13600 x 9016 at 640 with a halo of 35."""
    return tile_count(width_px, tile_px, halo_px) * tile_count(height_px, tile_px, halo_px)


def dpu_power(dpu: Dpu) -> Figure:
    """Power in W while the DPU runs, with the range assumed for it; unavailable where none is published."""
    if "dpu_run_w" not in dpu.tables.get("power", {}):
        return unavailable("W", f"no power of {dpu.target.name} under its DPU is published")
    anchor, assumed = dpu.limit("power", "dpu_run_w"), dpu.limit("power", "dpu_range_w")
    source = f"assumption anchored at {anchor.source}; range: {assumed.source}"
    return predicted(anchor.low, "W", (assumed.low, assumed.high), source)


def layer_energy_j(layer: LayerCost, dpu: Dpu) -> tuple[float, float]:
    """Least and most energy of a layer for one image, its share of the batch's weights included."""
    work = layer.work
    moved = work.load_map_bytes + work.store_map_bytes + work.weight_bytes / dpu.batch
    product, byte = dpu.limit("power", "product_j"), dpu.limit("power", "memory_byte_j")
    products = work.operations / 2
    return products * product.low + moved * byte.low, products * product.high + moved * byte.high


def image_energy_j(prediction: Prediction, dpu: Dpu) -> tuple[float, float]:
    """Least and most energy of all layers for one image."""
    ends = [layer_energy_j(layer, dpu) for layer in prediction.layers]
    return sum(low for low, _ in ends), sum(high for _, high in ends)


def counted_power(prediction: Prediction, dpu: Dpu) -> Figure:
    """Power of products and traffic at the predicted rate, in W; its range is that of the published figures."""
    low, high = (energy * prediction.fps for energy in image_energy_j(prediction, dpu))
    return predicted((low + high) / 2, "W", (low, high), energy_source(dpu))


def energy_source(dpu: Dpu) -> str:
    """Where the figures a step come from."""
    return "; ".join(dpu.limit("power", key).source for key in ("product_j", "memory_byte_j"))
