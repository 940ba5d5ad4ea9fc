"""Energy of arithmetic and of memory traffic, from published figures a step: a cross-check of the assumed power.

It counts products and moved bytes alone. Control, on-chip memories, clocks and leakage are left out, so it lies below
what a board draws; it is to be held against the published difference between a run with the DPU and one without.
"""

from deploy.dpu.board import Dpu
from deploy.dpu.cost import LayerCost, Prediction
from deploy.results import Figure, predicted


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
