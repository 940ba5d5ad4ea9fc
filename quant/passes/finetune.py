"""Train the integers themselves: weights and biases of the integer core, with rounding and clipping
in the loop.

Rounding each tensor optimally leaves errors that accumulate over many layers, and noise that no
rounding removes. The core is therefore run as it is, and its numbers follow the gradient of its
result's error (quantisation-aware training, Jacob et al. 2018). The error is measured from the
reference if there is one, and from the float network. Gradients do not change scales, because these
are powers of two.

1. Hold out some of the pairs.
2. Before each round of steps change scales by one bit if that reduces the error on training pairs
   (`quant.passes.scales`). The core stays within the windows of the DPU's shifts.
3. Take steps of gradient descent, and average the numbers over the last steps, because single steps
   cross rounding thresholds back and forth.
4. Every few steps round the averages, and keep the core with the least error on the held-out pairs.
5. Stop after a round of steps with little gain.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import onnx
import torch
from torch.optim.swa_utils import AveragedModel

from beers_deploy.model.progress import step
from beers_deploy.profiles.errors import ImageError
from beers_deploy.quant.core import SHIFTS, IntCore, Shifts
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import CORRECTION, Graph, graph_to_onnx
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.integer.trainable import Tensor, TrainableCore
from beers_deploy.quant.passes.scales import with_better_scales
from beers_deploy.quant.passes.trial import hardest_and_others
from beers_deploy.quant.samples.patches import Pair
from beers_deploy.quant.session import open_any_size, open_session, result_of, tensor_values
from beers_deploy.quant.untrusted import times

HELD_OUT_EVERY = 8
"""One of this number of pairs is not trained on, and is used to select the result."""
MOST_HELD_OUT = 48
"""The maximum number of these pairs."""
BATCH_PIXELS = 4 * 128**2
"""The number of pixels of the planes in one step."""
BORDER_PX = 8
"""This border is not compared with a reference if the sides of the result are at least four times
as long. A patch ends there, but its image continues. The float network has the same border.
"""
ROUNDS = (500, 1000, 2000, 4000)
"""The number of steps of each round of "auto"."""
DECAY = 0.98
"""The decay per step of the running average of the numbers."""
MOMENTUM = 0.9
STEADINESS = 0.99
"""Decays of the running means of a gradient and of its square."""
LEAST_GAIN = 0.02
"""A round that recovers less than this share of the initial INT8 loss gained little."""
JUDGED_EVERY = 50
"""The number of steps after which a result is compared on the pairs that are held out."""
JUDGING = 48
"""The number of training pairs on which scales are judged."""


@dataclass(frozen=True)
class Pace:
    """The size of the gradient steps in one round of fine-tuning.

    Attributes:
        share: the learning rate at the start of the round, as a share of the highest rate.
        by_tensor: True divides a gradient by the root mean square of its whole tensor; False
            divides each number's gradient by its own, as Adam does. Then small gradients that are
            mostly noise move their numbers as far as others. Once all these cross their rounding
            thresholds, the error multiplies: a network that INT8 harms little only gets worse.
    """

    share: float
    by_tensor: bool


PACES = (Pace(1.0, False), Pace(0.25, False), Pace(0.0625, True))
"""Which is best depends on the network. A depthwise one gains at the first alone, DnCNN at the
last.
"""


@dataclass(frozen=True)
class Tuning:
    """The parameters of fine-tuning.

    Attributes:
        pairs: the training images (1, C, H, W) as the network reads them, and their references,
            which may be empty.
        steps: the number of gradient steps; None adds rounds until the error on held-out pairs
            stops falling.
        rate: the highest learning rate, in units of each number's scale.
        seed: the seed of the order in which pairs are drawn.
        original: the float network whose results are learnt; None for that of the rounded graph,
            which differs if operators were replaced (`quant.adapt`).
    """

    pairs: Sequence[Pair]
    steps: int | None
    rate: float = 0.3
    seed: int = 0
    original: onnx.ModelProto | None = None


@dataclass(frozen=True)
class Sample:
    """An image in the form in which the core reads it, and the results that the core should have
    for it.

    These results are corrections (1, C, H', W'): what the core computes before the host adds the
    image.

    Attributes:
        image: (1, C, H, W) as the network reads it.
        planes: the int8 planes of the image, (1, P, H, W) as float32.
        floats: the float network's correction.
        reference: the correction with which the result would equal the reference, or None.
        weight: the weight of its errors: one over the float network's own error, so that dark and
            busy patches count equally. A number, or (N, 1, 1, 1) of a batch.
    """

    image: np.ndarray
    planes: Tensor
    floats: Tensor
    reference: Tensor | None
    weight: float | Tensor

    @classmethod
    def batches(cls, samples: Iterable["Sample"]) -> "Iterator[Sample]":
        """Join samples of one size to one, because that runs faster, with and without references.

        Yields:
            For N samples of a size one whose arrays have N in place of 1.
        """
        batches: dict[tuple[torch.Size, bool], list[Sample]] = {}
        for sample in samples:
            kind = sample.planes.shape, sample.reference is None
            batches.setdefault(kind, []).append(sample)
        for alike in batches.values():
            references = [sample.reference for sample in alike if sample.reference is not None]
            yield cls(
                np.concatenate([sample.image for sample in alike]),
                torch.cat([sample.planes for sample in alike]),
                torch.cat([sample.floats for sample in alike]),
                torch.cat(references) if references else None,
                torch.tensor([float(sample.weight) for sample in alike])[:, None, None, None],
            )

    def error(self, correction: Tensor) -> Tensor:
        """Return the weighted error of a computed correction, as a number that autograd can
        differentiate.

        Args:
            correction: (N, C, H', W') in the unit of `floats`.

        Returns:
            `weight` times the sum of two terms: the mean squared difference from the float
            network's correction, and that from the reference without its border, if there is one.
        """
        error = (self.weight * (correction - self.floats).square()).mean()
        if self.reference is not None:
            error = error + _inner_error(correction, self.reference, self.weight)
        return error


@torch.inference_mode(False)
def finetune(
    core: IntCore, full: Graph, tuning: Tuning, shifts: Shifts = SHIFTS
) -> tuple[IntCore, int]:
    """Train the integers of a core, and change its scales where that reduces the error.

    Gradients are computed even if the caller has switched them off, as with `torch.no_grad()`.

    Args:
        core: the integer core to start from.
        full: the float graph that reads the int8 planes that an image is split into, before
            equalisation.
        tuning: the training pairs, the number of steps and the learning rate.
        shifts: the smallest and largest shifts that the target allows.

    Returns:
        The core with the least error on held-out pairs, which is `core` itself if training finds
        nothing better, and the number of steps taken.

    Raises:
        ImageError: a reference of another size than the network's result.
    """
    # 1.
    samples = list(_samples(core.host_part, full, tuning))
    # If there are too few samples to hold one out, all are used for both.
    held_out = (samples[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY] or samples)[:MOST_HELD_OUT]
    training = [sample for number, sample in enumerate(samples, 1) if number % HELD_OUT_EVERY]
    # If a scale is too fine, the samples with the largest results clip first.
    order = sorted(training, key=lambda sample: float(sample.floats.abs().max()), reverse=True)
    judging = hardest_and_others(order, JUDGING)
    rounds = (tuning.steps,) if tuning.steps else ROUNDS
    most = f"{'' if tuning.steps else 'at most '}{sum(rounds)}"
    generator = torch.Generator().manual_seed(tuning.seed)
    trainable = TrainableCore(core)
    first = least = before = loss_of(core, held_out)
    done = 0
    paces = iter(PACES)
    pace = next(paces)
    for steps in rounds:
        # 2.
        step("fine-tuning: trying other scales")
        trainable = with_better_scales(
            trainable, full, shifts, lambda candidate: loss_of(candidate, judging)
        )
        # 3. and 4.
        for left, candidate in descend(trainable, training, steps, tuning.rate, pace, generator):
            loss = loss_of(candidate, held_out)
            if loss < least:
                core = candidate
                least = loss
            if left == steps:
                # The gain of other scales says nothing about the pace.
                before = least
            step(
                f"fine-tuning, step {done + steps - left} of {most}: held-out pairs lose "
                f"{least / max(first, LEAST_ERROR):.2f} of the first"
            )
        done += steps
        # 5.
        if before - least < LEAST_GAIN * first:
            slower = next(paces, None)
            if slower is None:
                break
            pace = slower
            trainable = TrainableCore(core)
    return core, done


def descend(
    trainable: TrainableCore,
    samples: Sequence[Sample],
    steps: int,
    highest_rate: float,
    pace: Pace,
    generator: torch.Generator,
) -> Iterator[tuple[int, IntCore]]:
    """Train the integers for one round by gradient descent with momentum, and average them.

    Gradients are divided by their running root mean square, as in Adam. The learning rate falls to
    0 as a half cosine. While it is high, parameters cross their rounding thresholds back and forth,
    so that evaluating the rounded core would mean little.

    Args:
        trainable: the core, whose parameters are changed in place.
        samples: the training samples; each step draws some of them with replacement.
        steps: the number of gradient steps.
        highest_rate: the learning rate of the first step if `pace.share` is 1, in units of each
            number's scale.
        pace: the size of the steps.
        generator: the generator that draws the samples.

    Yields:
        The number of steps that are left, and the rounded averages: before the first step, and each
        time that a multiple of JUDGED_EVERY steps are left.
    """
    average = AveragedModel(trainable, avg_fn=_averaged)
    parameters = list(trainable.parameters())
    means, mean_squares = ([torch.zeros_like(p) for p in parameters] for _ in range(2))
    # The number of samples follows from their size, so that a step costs about the same for any
    # size.
    count = max(BATCH_PIXELS // math.prod(samples[0].planes.shape[2:]), 1)
    for taken in range(steps + 1):
        average.update_parameters(trainable)
        left = steps - taken
        # Counted from the end, so that the last step is judged, where the rate is near 0.
        if left % JUDGED_EVERY == 0 or taken == 0:
            yield left, cast(TrainableCore, average.module).core()
        if left == 0:
            return
        rate = highest_rate * pace.share * 0.5 * (1 + math.cos(math.pi * taken / steps))
        trainable.zero_grad()
        drawn = torch.randint(len(samples), (count,), generator=generator).tolist()
        for batch in Sample.batches(samples[number] for number in drawn):
            share = len(batch.planes) / count
            error = share * batch.error(trainable.activated(batch.planes))
            error.backward()  # type: ignore[no-untyped-call]
        for parameter, mean, mean_square in zip(parameters, means, mean_squares, strict=True):
            gradient = cast(Tensor, parameter.grad)
            square = gradient.square()
            mean.lerp_(gradient, 1 - MOMENTUM)
            mean_square.lerp_(square.mean() if pace.by_tensor else square, 1 - STEADINESS)
            # Running means start at 0. Both divisors correct that.
            root = (mean_square / (1 - STEADINESS ** (taken + 1))).sqrt()
            # Without references, errors and gradients are small, so the number added to the root is
            # smaller.
            move = mean / (1 - MOMENTUM ** (taken + 1)) / (root + 1e-15)
            parameter.data.sub_(rate * move)


def _averaged(average: Tensor, number: Tensor, count: Tensor | int) -> Tensor:
    """Return the running average after one more step; `count` is the number of steps before it."""
    # The average follows early steps faster, so that short rounds train at all.
    decay = min(DECAY, (int(count) + 1) / (int(count) + 10))
    return average.lerp(number, 1 - decay)


def loss_of(core: IntCore, samples: Sequence[Sample]) -> float:
    """Return the mean error of a core in excess of the float network's own error.

    Args:
        core: a core, run as the host runs it in an INT8 file.
        samples: the samples on which the error is measured.

    Returns:
        The mean of the weighted squared errors, less the mean for the float network's corrections.
    """
    # Samples are corrections, so the host must stop once it has decoded the copies.
    host_part = replace(core.host_part, back=(), adds_image=False, last=(), limits=())
    session = open_session(host_model(replace(core, host_part=host_part), {}))
    errors = [float(s.error(torch.from_numpy(result_of(session, s.image)))) for s in samples]
    # The error of the float network is subtracted, because the integers do not cause it.
    in_float = [float(sample.error(sample.floats)) for sample in samples]
    return float(np.mean(errors)) - float(np.mean(in_float))


def _samples(host_part: HostPart, full: Graph, tuning: Tuning) -> Iterator[Sample]:
    """Yield a sample for each pair: its planes, and the corrections that the core should compute.

    Args:
        host_part: encodes images and turns restored images into corrections.
        full: the float network that reads all planes.
        tuning: the pairs, and the original network if there is one.

    Raises:
        ImageError: a reference of another size than the network's result.
    """
    session = open_session(graph_to_onnx(full, [CORRECTION], host_part.planes))
    original = None if tuning.original is None else open_any_size(tuning.original)
    for image, reference in tuning.pairs:
        if original is None:
            ((decoded,),) = tensor_values(session, [CORRECTION], image, None, host_part)
            floats = host_part.activated(decoded)
        else:
            floats = host_part.correction_of(image, result_of(original, image))
        planes = torch.from_numpy(host_part.encode(image).astype(np.float32)).to(
            memory_format=torch.channels_last
        )
        result = torch.from_numpy(floats)
        if not reference.size:
            yield Sample(image, planes, result, None, 1.0)
            continue
        size = times(reference.shape)
        expected = times(host_part.finish(image, floats).shape)
        if size != expected:
            raise ImageError(
                f"A reference has the size {size}, but the network's result has {expected}. Give "
                "references of the size of the results."
            )
        target = torch.from_numpy(host_part.correction_of(image, reference))
        # Errors are divided by the float network's own, so that dark and busy patches count alike.
        weight = 1 / max(float(_inner_error(result, target)), LEAST_ERROR)
        yield Sample(image, planes, result, target, weight)


LEAST_ERROR = 1e-9
"""Mean squared error over full scale (90 dB) below which a float network counts as perfect."""


def _inner_error(result: Tensor, target: Tensor, weight: float | Tensor = 1.0) -> Tensor:
    """Return the mean squared error without the border, which no network could restore.

    Args:
        result: corrections (N, C, H', W').
        target: the corrections that they should be, of the same shape.
        weight: the weight of each correction's error.

    Returns:
        A tensor of one number. A small result is compared as a whole.
    """
    # In a small result, most pixels would belong to the border.
    border_px = BORDER_PX if min(result.shape[2:]) >= 4 * BORDER_PX else 0
    height, width = result.shape[2:]
    inner = (result - target)[..., border_px : height - border_px, border_px : width - border_px]
    return (weight * inner.square()).mean()
