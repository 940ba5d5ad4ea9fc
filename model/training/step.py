"""Compute one gradient step on a device, without waiting for any result.

A GPU can therefore record the step once as a CUDA graph and replay it. The launch of some hundred
kernels takes longer than the kernels of a small network, and is paid only once. A step whose loss
or gradient is not finite changes no weight.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from beers_deploy.model.convbeers import Condition, Rounding, TrainableNetwork
from beers_deploy.model.training.losses import RestorationLoss
from beers_deploy.model.training.source import Batch

WARM_UPS = 3
"""The number of forward and backward passes before a recording, in which the libraries choose their
kernels.
"""

Agree = Callable[[Tensor], Tensor]
"""A function of a flag: for several workers, whether any has raised it; for one,
the flag itself.
"""


@dataclass
class Inputs:
    """The inputs of a step on its device. A recorded step reads the same memory each time.

    Attributes:
        batch: the patches, and the description of their sensors.
        steps: step sizes to which maps are rounded; without any they are not rounded.
        rate: the learning rate, a tensor of one number.
        share: the share of the new weights in their running average, a tensor of one number.
    """

    batch: Batch
    steps: list[Tensor]
    rate: Tensor
    share: Tensor

    def tensors(self) -> list[Tensor]:
        """Return all tensors in a fixed order."""
        degraded, reference, condition = self.batch
        return [degraded, reference, *(condition or ()), *self.steps, self.rate, self.share]


class Step:
    """One gradient step: forward, loss, backward, clipped gradients, Adam and the running average.

    Args:
        network: the network to train, on its device.
        loss: the function that computes the loss of its output.
        forward: the network, or a wrapper that averages its gradients over workers.
        gradient_norm: the norm to which larger gradients are clipped.
        bfloat16: True if the blocks compute in bfloat16.
        rounding: how maps are rounded; None does not round them.
        agree: see `Agree`; None for a single worker.

    Attributes:
        average: the running average of the weights by name.
        optimiser: Adam.
    """

    def __init__(
        self,
        network: TrainableNetwork,
        loss: RestorationLoss,
        forward: nn.Module,
        gradient_norm: float,
        bfloat16: bool,
        rounding: Rounding | None,
        agree: Agree | None,
    ) -> None:
        self.network = network
        self.loss = loss
        self.forward = forward
        self.agree = agree
        self.gradient_norm = gradient_norm
        self.bfloat16 = bfloat16
        self.rounding = rounding
        self.device = next(network.parameters()).device
        self.average = {k: v.detach().clone() for k, v in network.state_dict().items()}
        rate = torch.zeros((), device=self.device)
        on_gpu = self.device.type == "cuda"
        self.optimiser = torch.optim.Adam(
            network.parameters(), lr=rate, fused=True, capturable=on_gpu
        )
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: Inputs | None = None
        self._outputs: Tensor | None = None
        self.names: tuple[str, ...] = ()

    def __call__(self, batch: Batch, rate: float, share: float) -> Tensor:
        """Take a step.

        Args:
            batch: the batch of patches.
            rate: learning rate.
            share: the share of the new weights in their running average.

        Returns:
            (2 + T,) 1 for a step that changed nothing, the loss, and its terms in the order of
                `names`.
        """
        condition: Condition | None = None
        steps = list[Tensor]()
        if batch.condition is not None:
            condition = batch.condition.to(self.device)
            if self.rounding is not None:
                steps = [
                    step.to(self.device) for step in self.rounding.steps(batch.condition.gains)
                ]
        degraded = batch.degraded.to(self.device, memory_format=torch.channels_last)
        inputs = Inputs(
            Batch(degraded, batch.reference.to(self.device), condition),
            steps,
            *(torch.tensor(value, device=self.device) for value in (rate, share)),
        )
        if self.device.type != "cuda" or self.agree is not None:
            return self._taken(inputs)
        if self._graph is None:
            self._record(inputs)
        assert self._graph is not None and self._inputs is not None and self._outputs is not None  # noqa: S101, PT018
        for memory, value in zip(self._inputs.tensors(), inputs.tensors(), strict=True):
            memory.copy_(value)
        self._graph.replay()
        return self._outputs.clone()

    def _taken(self, inputs: Inputs) -> Tensor:
        total, terms = self._backward(inputs)
        norm = clip_grad_norm_(self.network.parameters(), self.gradient_norm)
        skipped = (~(torch.isfinite(total) & torch.isfinite(norm))).float()
        if self.agree is not None:
            # All workers skip a step that is bad for one of them, or their weights would diverge.
            skipped = self.agree(skipped)
        for group in self.optimiser.param_groups:
            group["lr"].copy_(inputs.rate)
        self.optimiser.found_inf = skipped  # type: ignore[attr-defined]
        self.optimiser.step()
        share = inputs.share * (1 - skipped)
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, share)
        self.names = tuple(terms)
        return torch.stack([skipped, total.detach(), *terms.values()])

    def _backward(self, inputs: Inputs) -> tuple[Tensor, Mapping[str, Tensor]]:
        batch = inputs.batch
        options: dict[str, object] = {"bfloat16": self.bfloat16}
        if batch.condition is not None:
            options |= {"condition": batch.condition, "steps": inputs.steps}
        restored = self.forward(batch.degraded, **options)
        total, terms = self.loss(restored, batch.reference)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        return total, terms

    def _record(self, inputs: Inputs) -> None:
        """Record a step; neither weights nor moments change."""
        # TF32 has the mantissa of 10 bits: the filters of the bank and a 12-bit image need more.
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cudnn.benchmark = True
        self._inputs = inputs
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UPS):
                self._backward(inputs)
            # Adam creates its moments in its first step, so this one is outside the recording and
            # changes nothing.
            self.optimiser.found_inf = torch.ones((), device=self.device)  # type: ignore[attr-defined]
            self.optimiser.step()
            self.optimiser.zero_grad(set_to_none=True)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        # Other threads simulate patches on the device meanwhile, which a recording forbids by
        # default.
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._outputs = self._taken(inputs)
