"""How long a network takes on the DPU, layer by layer, and how far off that may be.

Counts come from `work.py`, the formula from `layers.py` and `host.py`, constants and errors from the target's [cost],
where `docs/make_cost_model.py` writes what `fit.py` and `validation.py` find on published networks. None of them is
ConvBEERS: the paper's own figure is what the model is compared with, never what it is made from.

The interval is FPS e^-width to FPS e^width, so wide that nine of ten families of networks, each left out of the fit
once, lie inside; what widths made without a family hold of it is in docs/cost-model.md. It has one width where the
host sets the rate, one for small maps, one for large ones, and the widest where a network lies beyond all of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from deploy.dpu.board import Dpu
from deploy.dpu.checker.placement import Placement
from deploy.dpu.cost.constants import Constants, Regime, Structure, regime_of
from deploy.dpu.cost.host import Task, frame_rate, placed_work, task_of
from deploy.dpu.cost.layers import Layers
from deploy.dpu.cost.work import Work, count_work, largest_map_bytes
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
class Prediction:
    """What the model says of one network on one configuration; `note` says what was assumed of the file.

    Attributes:
        configuration: of the DPU.
        batch: images in flight: batch handlers of all cores.
        layers: what each costs, for a batch.
        overhead_s: start of a batch.
        host_s: time of an image on the host's cores together.
        task: what the host does with the results.
        regime: what sets the rate.
        width: half that of the interval, in ln(FPS).
        structure: variants of the formula.
        outside: what lies beyond the fitted networks; empty where nothing does.
    """

    configuration: str
    batch: int
    layers: tuple[LayerCost, ...]
    overhead_s: float
    host_s: float
    task: Task
    regime: Regime
    width: float
    structure: Structure
    outside: tuple[str, ...] = ()
    note: str = ""

    @cached_property
    def batch_time_s(self) -> float:
        """Time of one batch on the DPU: the layers and the overhead, nothing else."""
        return math.fsum([*(layer.time_s for layer in self.layers), self.overhead_s])

    @property
    def fps(self) -> float:
        """Images a second, batches back to back, the host working on others beside them."""
        return self.rate(self.batch_time_s, self.host_s)

    @property
    def fps_interval(self) -> tuple[float, float]:
        """Least and most images a second."""
        spread = math.exp(self.width)
        return self.fps / spread, self.fps * spread

    def rate(self, batch_time_s: float, host_s: float) -> float:
        """Images a second if a batch took that long on the DPU, and an image that long on the host."""
        return frame_rate(batch_time_s / self.batch, host_s, self.structure.crowding)

    @property
    def operations(self) -> int:
        """int8 operations for one image."""
        return sum(layer.work.operations for layer in self.layers)

    @property
    def streamed_bytes(self) -> int:
        """Feature-map bytes that one image moves through memory."""
        return sum(layer.work.load_map_bytes + layer.work.store_map_bytes for layer in self.layers)


def predict(placement: Placement, dpu: Dpu) -> Prediction:
    """Predict a network that runs whole on the DPU.

    Raises:
        ModelError: a node that the DPU cannot run, or nothing for it to do.
        ProfileError: a target without cost constants.
    """
    if placement.failed:
        names = ", ".join(node.op.name for node in placement.failed[:3])
        remedy = "run 'beers-deploy check' for the reasons and remedies"
        raise ModelError("cost model", expected="a core that runs whole on the DPU", got=names, remedy=remedy)
    constants, structure = Constants.of(dpu), Structure.of(dpu)
    works = count_work(placement.core, dpu)
    if not any(work.operations for work in works):
        remedy = "give a network with convolutions"
        raise ModelError("cost model", expected="work for the DPU", got="no convolution", remedy=remedy)
    layers = _layer_costs(works, dpu, constants, structure)
    host_s = float(placed_work(placement) @ constants.host_s_per_unit) / dpu.whole("cpu", "cores")
    dpu_s = math.fsum([*(layer.time_s for layer in layers), constants.batch_s]) / dpu.batch
    map_bytes = largest_map_bytes(placement.core)
    regime = regime_of(host_s > dpu_s, map_bytes)
    outside = _outside(placement.core, map_bytes, dpu)
    width = dpu.value("cost", WIDTHS["outside" if outside else regime])
    task, note = task_of(placement), placement.note
    return Prediction(
        dpu.name, dpu.batch, layers, constants.batch_s, host_s, task, regime, width, structure, outside, note
    )


def _layer_costs(
    works: Sequence[Work], dpu: Dpu, constants: Constants, structure: Structure
) -> tuple[LayerCost, ...]:
    layers = Layers.of(works, dpu)
    columns = (
        layers.compute_s(constants),
        layers.memory_s(constants, structure),
        layers.time_s(constants, structure),
    )
    return tuple(LayerCost(*row) for row in zip(works, *(c.tolist() for c in columns), strict=True))


WIDTHS = {
    "host": "width_host",
    "small maps": "width_small_maps",
    "large maps": "width_large_maps",
    "outside": "width_outside",
}
"""Where [cost] keeps half the width of an interval, in ln(FPS)."""


def _outside(core: Sequence[Operation], map_bytes: float, dpu: Dpu) -> tuple[str, ...]:
    """What of a network lies beyond the fitted ones, each with the end of the range that it passes."""
    values = {
        "map_bytes": ("largest map", map_bytes / 1e6, 1e-6, " MB"),
        "operations": ("work", sum(op.operations for op in core) / 1e9, 1e-9, " GOP"),
    }
    found = []
    for key, (name, value, scale, unit) in values.items():
        most = scale * dpu.limit("cost", f"fitted_{key}").high
        if value > most:
            found.append(f"{name} {value:.3g}{unit} (fitted up to {most:.3g})")
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
