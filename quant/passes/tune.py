"""Train the whole numbers themselves: weights and biases of the integer core, roundings and
clippings in the loop.

Rounding each tensor as well as it can be done leaves errors that meet behind many layers, and noise
that no rounding takes back. Here the core is run as it is, and its numbers follow the slope of what
its result errs by (training that sees the quantiser, Jacob et al. 2018): from the reference where
there is one, and from the float network. Scales and shifts stay, so the core stays as legal as it
was.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from beers_deploy.model.progress import step
from beers_deploy.profiles.errors import ImageError
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import CORRECTION, Graph, graph_to_onnx
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.integer.trainable import Tensor, TrainableCore
from beers_deploy.quant.samples import Pair, Remade
from beers_deploy.quant.session import open_session, result_of, tensor_values
from beers_deploy.quant.untrusted import times

HELD_OUT_EVERY = 8
"""One pair of so many is not trained on, but judges what is kept."""
MOST_HELD_OUT = 16
BATCH_PIXELS = 4 * 128**2
"""Of the planes that one step looks at."""
BORDER_PX = 8
"""Not held against a reference in a result of at least four times as many a side: there a patch
ends, and its image goes on. The float network has the same border.
"""
ROUNDS = (400, 800, 1600)
"""Steps of each round of "auto"."""
LEAST_GAIN = 0.02
"""Of what INT8 lost at first: a round that wins back less is the last one."""
JUDGED_EVERY = 20


@dataclass(frozen=True)
class Tuning:
    """What to train on, how long and how fast.

    Attributes:
        pairs: images (1, C, H, W) in [0, 1] and their references, which may be empty.
        steps: gradient steps; None adds rounds of them until pairs that are held out err no less.
        rate: the highest rate of learning, in units of each number's scale.
        seed: of the order of the pairs.
    """

    pairs: Remade[Pair]
    steps: int | None = None
    rate: float = 0.05
    seed: int = 0


@dataclass(frozen=True)
class Sample:
    """What a pair is to the core: an image in, corrections (1, C, H', W') wanted out.

    Attributes:
        image: (1, C, H, W) in [0, 1].
        planes: of the image, (1, P, H, W) as float32.
        floats: what the float network makes of it.
        reference: the correction that would restore it wholly, or None.
        weight: of its errors: over the float network's own, so that dark and busy patches count
            alike.
    """

    image: np.ndarray
    planes: Tensor
    floats: Tensor
    reference: Tensor | None
    weight: float

    def error(self, correction: Tensor) -> Tensor:
        """The mean squared errors of a correction, added up and weighted."""
        error = (correction - self.floats).square().mean()
        if self.reference is not None:
            error = error + _inner_error(correction, self.reference)
        return self.weight * error


class Judge:
    """Keeps the core whose results, as the host computes them, lose least on samples that it is not
    trained on.

    What is lost is the mean error beyond the float network's own.
    """

    def __init__(self, core: IntCore, held: list[Sample]) -> None:
        self._held = held
        # The float network errs from a reference as well, and no integers can be blamed for that.
        self._in_float = float(np.mean([float(sample.error(sample.floats)) for sample in held]))
        self.core = core
        self.first = self.loss(core)
        self.least = self.first

    def loss(self, core: IntCore) -> float:
        """What a core loses."""
        # Samples are corrections, so the host must stop once it has merged gains or windows.
        host_part = replace(core.host_part, back=(), adds_image=False, last=())
        session = open_session(host_model(replace(core, host_part=host_part), {}))
        results = (torch.from_numpy(result_of(session, sample.image)) for sample in self._held)
        errors = [
            float(sample.error(result)) for sample, result in zip(self._held, results, strict=True)
        ]
        return float(np.mean(errors)) - self._in_float

    @property
    def share(self) -> float:
        """Of what was lost at first, what still is."""
        return self.least / max(self.first, LEAST_ERROR)

    def see(self, core: IntCore) -> None:
        """Keep a core that loses less than all before."""
        loss = self.loss(core)
        if loss < self.least:
            self.core = core
            self.least = loss


class Descent:
    """The steps by Adam; in each round the rate of learning falls to 0 as a half cosine.

    While the rate is high, numbers turn to and fro at the thresholds of their rounding, and no
    judgement is of use.
    """

    def __init__(self, trainable: TrainableCore, samples: list[Sample], tuning: Tuning) -> None:
        self._trainable = trainable
        self._samples = samples
        self._rate = tuning.rate
        self.done = 0
        self._generator = torch.Generator().manual_seed(tuning.seed)
        # Without references errors and gradients are small: Adam's eps must be smaller still.
        self._optimiser = torch.optim.Adam(trainable.parameters(), eps=1e-15)
        self._batch = max(BATCH_PIXELS // math.prod(samples[0].planes.shape[2:]), 1)

    def round(self, steps: int) -> Iterator[int]:
        """So many steps; yields how many of them are left."""
        for taken in range(steps):
            self._optimiser.param_groups[0]["lr"] = (
                self._rate * 0.5 * (1 + math.cos(math.pi * taken / steps))
            )
            self._optimiser.zero_grad()
            numbers = torch.randint(len(self._samples), (self._batch,), generator=self._generator)
            for number in numbers.tolist():
                sample = self._samples[number]
                error = sample.error(self._trainable(sample.planes))
                # Gradients of the batch add up sample by sample, whose sizes may differ.
                (error / self._batch).backward()
            self._optimiser.step()
            self.done += 1
            yield steps - taken - 1


def tune(core: IntCore, full: Graph, tuning: Tuning) -> tuple[IntCore, int]:
    """The core with the numbers that erred least on pairs that they were not trained on, and the
    steps taken.

    Args:
        core: to start from; it comes back as it is where training finds nothing better.
        full: the float network that reads all planes.
        tuning: on what, how long, how fast.
    """
    samples = list(_samples(core.host_part, full, tuning.pairs))
    # Too few samples to hold one out are trained on and judged by.
    validation = (samples[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY] or samples)[:MOST_HELD_OUT]
    training = [sample for k, sample in enumerate(samples) if (k + 1) % HELD_OUT_EVERY] or samples
    trainable = TrainableCore(core)
    judge = Judge(core, validation)
    descent = Descent(trainable, training, tuning)
    rounds = (tuning.steps,) if tuning.steps else ROUNDS
    most = f"{'' if tuning.steps else 'at most '}{sum(rounds)}"
    for steps in rounds:
        before = judge.least
        for remainder in descent.round(steps):
            # Counted from the end, so that the last step is judged, where the rate is near 0.
            if remainder % JUDGED_EVERY == 0:
                judge.see(trainable.core())
                step(
                    f"fine-tuning, step {descent.done} of {most}: held-out pairs lose "
                    f"{judge.share:.2f} of the first"
                )
        if before - judge.least < LEAST_GAIN * judge.first:
            break
    return judge.core, descent.done


def _samples(host_part: HostPart, full: Graph, pairs: Remade[Pair]) -> Iterator[Sample]:
    session = open_session(graph_to_onnx(full, [CORRECTION], host_part.planes))
    for image, reference in pairs:
        ((floats,),) = tensor_values(session, [CORRECTION], image, None, host_part)
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
        # Over the float network's own error, dark and busy patches count alike.
        weight = 1 / max(float(_inner_error(result, target)), LEAST_ERROR)
        yield Sample(image, planes, result, target, weight)


LEAST_ERROR = 1e-9
"""Mean squared, of full scale: below it, by 90 dB, a float network is as good as perfect."""


def _inner_error(result: Tensor, target: Tensor) -> Tensor:
    """Mean squared, but for a border that no network could restore."""
    # In a small result the border would be most of it.
    border_px = BORDER_PX if min(result.shape[2:]) >= 4 * BORDER_PX else 0
    height, width = result.shape[2:]
    inner = (result - target)[..., border_px : height - border_px, border_px : width - border_px]
    return inner.square().mean()
