"""Choose how each kind of operator that a DPU lacks is replaced, and measure the loss.

1. Replace each kind by the other function, alone, and compensate.
2. Where that still loses more than `ENOUGH_DB`, use the exact replacement if there is one: it loses
   nothing in float, but needs more operations.
3. Replace all kinds as chosen, and compensate jointly.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.quant.adapt.compensation import compensated
from beers_deploy.quant.adapt.inverse_deviation import fit_inverses
from beers_deploy.quant.adapt.kinds import APPROXIMATIONS, EXACT, Kind, nodes_by_kind
from beers_deploy.quant.adapt.replacements import replaced
from beers_deploy.quant.gate import GateResult, compare, figure_of
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.graph.normalization import InverseDeviation, Normalization
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.simplify.activations_first import behind_convolutions
from beers_deploy.quant.tiling.receptive_field import tiling_of

ADAPTED = "adapted"
"""The table of replaced operators, and the key of its record in an INT8 file."""
ENOUGH_DB = 0.05
"""An approximation is preferred to an exact replacement up to this loss of PSNR."""
NEAR_DB = 60.0
"""The same limit without references, as PSNR to the original's results: if these restore to 40 dB,
an error of 60 dB loses 0.04 dB.
"""
FIT_IMAGES = 32
FIT_PX = 48
"""The maximum number of images, and their side in pixels, on which convolutions are fitted."""
FEWEST_FIT_IMAGES = 4
"""The minimum number. A network of a larger fixed size is fitted on fewer images, with as many
pixels in all, because each fit runs it on all of them.
"""


@dataclass(frozen=True)
class Adapted:
    """A float network whose operators a DPU computes, and the loss by the replacement of others.

    Attributes:
        model: the network.
        rows: table rows, one for each kind of replaced operator, with the PSNR lost in float.
        record: the same in words, for the metadata of a file; empty if nothing was replaced.
    """

    model: onnx.ModelProto
    rows: tuple[Row, ...] = ()
    record: str = ""


@dataclass(frozen=True)
class Candidate:
    """A network with replaced operators, compared with the original network on held-out samples.

    Convolutions may be fitted to make up for the replacement (compensation).

    Attributes:
        model: the compensated network, or the one without compensation if that is nearer to the
            original.
        before: the differences from the original without compensation.
        after: the differences of `model` from the original.
    """

    model: onnx.ModelProto
    before: GateResult
    after: GateResult

    @property
    def is_enough(self) -> bool:
        """True if `model` loses at most ENOUGH_DB of PSNR, so that an exact replacement is not
        needed.

        Without references its PSNR against the original's results must be at least NEAR_DB.
        """
        if math.isnan(self.after.drop_db):
            return self.after.psnr_between_db >= NEAR_DB
        return self.after.drop_db <= ENOUGH_DB

    @property
    def figures(self) -> dict[str, Figure]:
        """The loss before and after compensation in dB, by the name of the table's column."""
        source = f"{self.after.source} that no convolution was fitted on, in float"
        figures = {}
        for name, result in (("replaced", self.before), ("compensated", self.after)):
            values = {"PSNR lost": result.drop_db, "PSNR to the original": result.psnr_between_db}
            for key, value in values.items():
                missing = "the samples have no references"
                figures[f"{key}, {name}"] = figure_of(value, "dB", source, missing)
        return figures


def adapt(model: onnx.ModelProto, samples: Patches, held_out: Patches) -> Adapted:
    """Replace the operators that a DPU lacks, and fit convolutions to make up for the replacement.

    Args:
        model: a simplified float network; not changed.
        samples: the samples that convolutions are fitted on.
        held_out: other samples, on which the loss is measured.

    Returns:
        The network and its loss; `model` without rows if the DPU lacks none of its operators.

    Raises:
        ModelError: the network has other operators that no DPU computes.
    """
    graph = OnnxGraph(model)
    by_kind = nodes_by_kind(graph)
    counts = {kind: len(nodes) for kind, nodes in by_kind.items()}
    if not counts:
        return Adapted(model)
    exact = {kind for kind in counts if kind not in APPROXIMATIONS}
    # Raises an error if the DPU still lacks an operator, before the work of fitting.
    read_network(replaced(model, counts.keys() - exact, exact, {}))
    images = _fit_images(model, samples.degraded)
    ends = by_kind.get(Kind.normalization, ())
    normalizations = [each for each in (Normalization.of(graph, node) for node in ends) if each]
    inverses = fit_inverses(model, normalizations, images)
    # 1. and 2.
    trials = dict[Kind, Candidate]()
    for kind in [kind for kind in counts if kind in APPROXIMATIONS]:
        trials[kind] = _trial(model, {kind}, set(), images, held_out, inverses)
        if kind in EXACT and not trials[kind].is_enough:
            exact.add(kind)
    # 3. If there is only one kind, its trial in 1. is already the result.
    if len(counts) == 1 and not exact:
        (chosen,) = trials.values()
    else:
        chosen = _trial(model, counts.keys() - exact, exact, images, held_out, inverses)
    is_fitted = chosen.after is not chosen.before
    how = "compensated" if is_fitted else "not compensated: no fit is nearer"
    rows = []
    for kind, count in counts.items():
        becomes = f"{APPROXIMATIONS[kind]}, {how}"
        if kind in exact:
            becomes = f"{EXACT[kind]}, exactly"
        figures = trials[kind].figures if kind in trials else {}
        rows.append(Row(ADAPTED, f"{count} {kind}", figures, {"becomes": becomes}))
    record = "; ".join(f"{row.name}: {row.text['becomes']}" for row in rows)
    rows.append(Row(ADAPTED, "all", chosen.figures))
    return Adapted(behind_convolutions(chosen.model), tuple(rows), record)


def _trial(
    model: onnx.ModelProto,
    approximated: Collection[Kind],
    exact: Collection[Kind],
    images: Sequence[np.ndarray],
    held_out: Patches,
    inverses: Mapping[str, InverseDeviation],
) -> Candidate:
    """Replace some kinds of operators by other functions and some exactly, and compensate."""
    network = replaced(model, approximated, exact, inverses)
    session = open_any_size(model)
    before = compare(session, open_any_size(network), held_out)
    # Maps around a mirrored image are no longer those of the original.
    if not approximated or Kind.padding in approximated:
        return Candidate(network, before, before)
    nodes = nodes_by_kind(OnnxGraph(model))
    approximations = chain.from_iterable(nodes[kind] for kind in approximated)
    changed = [node.outputs[0] for node in approximations]
    fitted = compensated(model, network, changed, images)
    after = compare(session, open_any_size(fitted), held_out)
    # Compared with the original, not with the references: a change may gain by chance on few
    # samples.
    if after.psnr_between_db < before.psnr_between_db:
        return Candidate(network, before, before)
    return Candidate(fitted, before, after)


def _fit_images(model: onnx.ModelProto, images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return some of the images, cut to FIT_PX a side if the network accepts that size."""
    side_px = fixed_tile_px(model)
    count = FIT_IMAGES
    if side_px is None:
        try:
            alignment_px = tiling_of(model).alignment_px
        except ModelError:
            # Perhaps an operator that is to be replaced prevents tiling.
            alignment_px = FIT_PX
        side_px = up_to_multiple(FIT_PX, alignment_px)
    else:
        count = int(np.clip(FIT_IMAGES * FIT_PX**2 // side_px**2, FEWEST_FIT_IMAGES, FIT_IMAGES))
    places = np.unique(np.linspace(0, len(images) - 1, count).astype(int))
    return [images[int(k)][..., :side_px, :side_px] for k in places]
