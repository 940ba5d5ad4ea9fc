"""Plan how a float network becomes an integer core, and carry the plan out on calibration images.

The steps have the numbers of `quant.quantize`.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from beers_deploy.model.progress import step
from beers_deploy.quant.core import IntCore, RoundedConvs, Shifts, build_core
from beers_deploy.quant.graph import CORRECTION, PLANES, Conv, Graph, channels_of, tensors
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.passes.dual_range import with_copies, with_windows
from beers_deploy.quant.passes.effort import Effort, Stage, bound, channel_groups, work_of
from beers_deploy.quant.passes.equalize import (
    FIRST_GUESSES,
    FULL,
    GAMMAS,
    channel_ranges,
    equalize,
    first_guess,
    search,
)
from beers_deploy.quant.passes.equalize_single import (
    SingleTensors,
    equalize_single,
    single_ranges,
)
from beers_deploy.quant.passes.least_squares import choose_frac_bits
from beers_deploy.quant.passes.residual_groups import (
    GROUP_FRAC_BITS,
    ResidualGroup,
    exceeds_six,
    finer_members,
    n_factors,
    single_tensors,
)
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.passes.trial import (
    BRIGHT,
    CropTrials,
    Target,
    Trials,
    brightened,
    crop_count,
    search_targets,
)
from beers_deploy.quant.session import crops, halo_of

logger = logging.getLogger(__name__)

FAR_LESS = 0.7
"""Groups are given up if scales of their own, not yet equalised, leave less than this share of the
error. ConvBEERS keeps 0.95 of it (measured), and then gains nothing from them.
"""
CLEARLY_LESS = 0.85
"""Single tensors next to groups of dense convolutions are equalised only if that leaves less than
this share of the error. In six small networks it left 0.40, 0.71 and 0.72, or 0.95 and more
(measured); the latter gained at most 0.01 dB and had larger single errors.
"""


@dataclass(frozen=True)
class Plan:
    """A float network and everything that decides how it becomes an integer core.

    `rounded` carries a plan out on calibration images.

    Attributes:
        graph: a float graph that reads the int8 planes that an image is split into instead of the
            image.
        host_part: the host's pre- and post-processing.
        groups: residual groups, each a set of tensors that adds connect and that share one scale.
        singles: tensors whose channels are equalised in addition to the groups, or without groups.
        shifts: the smallest and largest shifts that the target allows.
        passes: the passes that reduce the error.
        effort: the effort of the search for equalisation factors.
        brightens: True if factors, or scales without factors, are also chosen for images that are
            brightened to full scale.
    """

    graph: Graph
    host_part: HostPart
    groups: list[ResidualGroup]
    singles: SingleTensors
    shifts: Shifts
    passes: Passes = ALL
    effort: Effort = Effort.normal
    brightens: bool = False

    def stages(self) -> list[Stage]:
        """Return the separate searches for equalisation factors, in order: the residual groups,
        then the single tensors.

        Effort and time of the search are estimated from them before it begins.
        """
        groups = self.groups if self.passes.equalization else []
        stages = [Stage(group, FIRST_GUESSES, n_factors(group)) for group in groups]
        singles = self.singles.stages(self.effort) if self.singles.tensors else []
        return [*stages, *singles]

    def core(
        self,
        candidate: Graph,
        frac_bits: Mapping[str, int],
        earlier: RoundedConvs | None = None,
        finer: Mapping[str, int] | None = None,
    ) -> IntCore:
        """Round a float graph to an integer core, and return it.

        Args:
            candidate: the plan's graph after some passes: equalised, or with copies of its result.
            frac_bits: the number of fractional bits of the scale of least squared error, for each
                tensor by its name. Equalised tensors get GROUP_FRAC_BITS instead.
            earlier: convolutions that were rounded before, which are not rounded again; new ones
                are added.
            finer: the fractional bits of equalised tensors that have others.

        Raises:
            ModelError: the DPU's shifts do not reach all scales.
        """
        # Equalised tensors are scaled to fill int8 at one scale.
        shared = [*chain.from_iterable(self.groups), *self.singles.tensors]
        scales = {**frac_bits, **dict.fromkeys(shared, GROUP_FRAC_BITS), **(finer or {})}
        # A coarse copy holds what a finer scale clips.
        scales[CORRECTION] += self.host_part.decoding.finer_bits
        assert set(tensors(candidate)) <= set(scales)  # noqa: S101
        return build_core(candidate, scales, self.shifts, self.host_part, earlier)


def singles_of(graph: Graph, host_part: HostPart, groups: list[ResidualGroup]) -> SingleTensors:
    """Return the tensors that are equalised in addition to these groups."""
    depthwise = any(isinstance(op, Conv) and op.groups > 1 for op in graph)
    names = tuple(single_tensors(graph))
    widths = channels_of(graph, {PLANES: host_part.planes})
    return SingleTensors(names, tuple(widths[name] for name in names), depthwise or not groups)


def carry_out(plan: Plan, images: Sequence[np.ndarray]) -> tuple[IntCore, Graph]:
    """Carry out a plan on calibration images: choose scales, equalise, and round to integers.

    These are steps 3 to 7 of the module.

    Args:
        plan: the float network and the passes to apply.
        images: calibration images (1, C, H, W) float32 as the network reads them.

    Returns:
        The integer core, and the float graph after the passes, which was rounded to it.

    Raises:
        ModelError: the DPU's shifts do not reach all scales.
    """
    # 3.
    step("scale of each tensor")
    calibration = list(images)
    if plan.brightens and not (plan.groups or plan.singles.tensors):
        # No factor passes through HardSwish: scales alone keep bright ground from clipping. Where
        # factors are searched, this cost two networks 0.04 and 0.07 dB (measured).
        ranges = plan.host_part.input_ranges
        calibration += [brightened(image, ranges) for image in images[::BRIGHT]]
    frac_bits = choose_frac_bits(plan.graph, calibration, plan.host_part, plan.passes.least_squares)
    # 4. ReLU6 is replaced by the end of int8, which would also clip sums beyond six.
    groups = [group for group in plan.groups if not exceeds_six(plan.graph, group, frac_bits)]
    if len(groups) < len(plan.groups):
        plan = replace(plan, groups=groups, singles=singles_of(plan.graph, plan.host_part, groups))
    # 5.
    if plan.passes.dual_range:
        host_part = with_windows(plan.graph, plan.host_part, frac_bits[CORRECTION], images)
        plan = replace(plan, host_part=host_part)
    # 6. Copies are written already, so that the search rounds its last convolution once.
    unscaled = with_copies(plan.graph, plan.host_part.decoding)
    if not (plan.groups or plan.singles.tensors):
        return plan.core(unscaled, frac_bits), unscaled
    graph, targets = _equalized(unscaled, plan, frac_bits, images)
    # 7.
    own = choose_frac_bits(graph, calibration, plan.host_part, False) if plan.groups else {}
    core = plan.core(graph, frac_bits, finer=finer_members(graph, plan.groups, own))
    if not (plan.groups and plan.passes.equalization):
        return core, graph
    # If sums grow much, one scale for all of them is too coarse for the first. It cost a small
    # network that sharpens colours by panchromatic detail 0.56 instead of 0.12 dB (measured).
    apart = replace(plan, groups=[], singles=SingleTensors((), ()))
    own_scales = CropTrials(lambda candidate: apart.core(candidate, frac_bits), targets)
    one_scale = CropTrials(lambda _: core, targets)
    if own_scales.error(unscaled) >= FAR_LESS * one_scale.error(graph):
        return core, graph
    plan = replace(apart, singles=singles_of(plan.graph, plan.host_part, []))
    if plan.singles.tensors:
        unscaled, _ = _equalized(unscaled, plan, frac_bits, images)
    return plan.core(unscaled, frac_bits), unscaled


def _equalized(
    graph: Graph, plan: Plan, frac_bits: Mapping[str, int], images: Sequence[np.ndarray]
) -> tuple[Graph, list[Target]]:
    """Equalise the channels of the groups, then those of the single tensors, and report the
    expected time before.

    Returns:
        The graph, and the crops on which errors were compared.
    """
    first_crop, *others = crops(images[0], halo_of(graph))
    count = crop_count(first_crop, len(images) * (1 + len(others)))
    work = work_of(graph, plan.host_part, first_crop)
    limit = bound(plan.stages(), graph, work, count, plan.effort)
    step("float results to compare with")
    targets = search_targets(plan.graph, plan.host_part, images, limit.crops, plan.brightens)
    earlier: RoundedConvs = {}
    trials = CropTrials(lambda candidate: plan.core(candidate, frac_bits, earlier), targets)
    graph = plan.singles.scaled(graph, plan.singles.unscaled(frac_bits))
    # The time is only reported: the candidates depend on counted work alone.
    start = time.perf_counter()
    trials.error(graph)
    seconds = max((time.perf_counter() - start) * limit.runs, 1)
    # Two more compare one scale for each group with scales of their own, and two more decide
    # whether the single tensors next to groups are equalised.
    count = limit.candidates + 4 * bool(plan.groups)
    logger.info("equalisation tries at most %d candidates, in about %.0f s", count, seconds)
    graph = _equalized_groups(graph, plan, trials, images, limit.groups)
    return _equalized_singles(graph, plan, trials, images, limit.groups), targets


def _equalized_groups(
    graph: Graph, plan: Plan, trials: Trials, images: Sequence[np.ndarray], most_groups: int
) -> Graph:
    """Equalise one group after the other; groups that follow have a first guess until then."""
    ranges = [channel_ranges(plan.graph, group, images, plan.host_part) for group in plan.groups]
    guesses = [first_guess(group_ranges, GAMMAS[0], 1.0) for group_ranges in ranges]
    for group, guess in zip(plan.groups[1:], guesses[1:], strict=True):
        graph = equalize(graph, group, guess)
    for number, group in enumerate(plan.groups):
        step(f"equalising the channels of residual group {number + 1} of {len(plan.groups)}")
        # The search starts from the group as it is in the float network.
        if number:
            graph = equalize(graph, group, 1 / guesses[number])
        if plan.passes.equalization:
            channels = channel_groups(ranges[number], most_groups)
            factors = search(graph, group, ranges[number], trials(graph, group), channels)
        else:
            factors = first_guess(ranges[number], 0.0, 1.0)
        graph = equalize(graph, group, factors)
    return graph


def _equalized_singles(
    graph: Graph, plan: Plan, trials: CropTrials, images: Sequence[np.ndarray], most_groups: int
) -> Graph:
    """Equalise the single tensors.

    If the image itself is in these tensors, they are scaled such that no calibration value clips.
    """
    if not plan.singles.tensors:
        return graph
    step(f"equalising the channels of {len(plan.singles.tensors)} tensors")
    ranges = single_ranges(graph, plan.singles, images, plan.host_part)
    factors = equalize_single(graph, plan.singles, ranges, trials, plan.effort, most_groups)
    scaled = plan.singles.scaled(graph, factors)
    next_to_group = not plan.singles.by_channel
    if next_to_group and trials.error(scaled) > CLEARLY_LESS * trials.error(graph):
        return graph
    graph = scaled
    if not plan.host_part.decoding.offsets:
        return graph
    # Here the tensors contain the image itself, and the host adds nothing that could make up for a
    # clip.
    largest = single_ranges(graph, plan.singles, images, plan.host_part, 1.0, 1.0)
    return plan.singles.scaled(graph, FULL / np.maximum(largest, FULL))
