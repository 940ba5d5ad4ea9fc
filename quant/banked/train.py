"""The body of a family trained in whole numbers: roundings and clippings in the loop, every sensor in the batch.

Each patch comes behind the bank of its own sensor, as that sensor's file will compute it, and is held against the
reference without noise, which the float network was trained on. Scales and shifts stay as calibration chose them.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import torch
from torch.nn import functional

from beers_deploy.model.bank import UNIT_STEPS, bank_of_vector
from beers_deploy.model.family import SensorFamily
from beers_deploy.model.progress import Log, no_log
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.patches import PatchRecipe, PatchSource
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.sensor_file import REFERENCE
from beers_deploy.quant.banked.calibrate import LIKE, front_ends
from beers_deploy.quant.banked.filters import BITS, COPIES, gain_of, whole_bank
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.graph import CORRECTION
from beers_deploy.quant.integer.trainable import Tensor, TrainableCore, lift, rounded, to_int8

STEPS = 3000
"""Of "auto"."""

BATCH, PATCH_PX = 8, 96
"""Patches of a step and their side, as the float networks were trained."""

RATE, WARM_UP = 0.03, 50
"""The highest rate of learning, in units of each weight's scale, and the steps that lead to it."""

CLEAN_SNR = 10_000.0, 20_000.0
"""Of the reference, at its two radiances."""

LOG_EVERY = 20
LEAST_ERROR = 1e-8
"""Mean squared, of full scale."""


class TrainableBody(TrainableCore):
    """A body that reads the banks of a batch of sensors: each sensor's gain multiplies the biases."""

    def restored(self, images: np.ndarray, vectors: np.ndarray) -> Tensor:
        """Images (N, 1, H, W) in [0, 1] restored as the files of sensors with these vectors (N, 4) do it."""
        scale = round(math.sqrt(self._core.ends.outputs))
        planes = torch.from_numpy(front_ends(scale).split(images).astype(np.float32))
        banks = [_bank(tuple(map(float, vector)), scale) for vector in vectors]
        seen = torch.cat([bank(image[None]) for bank, image in zip(banks, planes, strict=True)])
        self._gains = torch.tensor([bank.gain for bank in banks]).view(-1, 1, 1, 1)
        told = torch.from_numpy(vectors * 2.0 ** (BITS - 1))[:, :, None, None].float() * self._gains
        correction = self(torch.cat([seen, told.expand(-1, -1, *seen.shape[2:])], 1))
        copies = seen[:, -COPIES[2] * scale**2 :].reshape(len(seen), COPIES[2], scale**2, *seen.shape[2:])
        analytic = copies.mean(1) / UNIT_STEPS
        units = torch.tensor([bank.unit for bank in banks]).view(-1, 1, 1, 1) / self._gains
        return torch.from_numpy(images) + functional.pixel_shuffle(units * (correction + analytic), scale)

    def _convolved(self, op: IntConv, weight: Tensor, bias: Tensor, image: Tensor) -> Tensor:
        """As for one sensor; biases are not rounded, for each sensor has its own."""
        frac_bits = self._core.frac_bits[op.output]
        unit = 2.0 ** (frac_bits - op.weight_frac_bits - self._core.frac_bits[op.input])
        added = self._gains * bias[:, None, None] * 2.0 ** (frac_bits - op.bias_frac_bits)
        sums = functional.conv2d(image, to_int8(weight) * unit, padding=op.window.pads[:2]) + added
        if op.output == CORRECTION:
            return sums
        return rounded(sums + lift(op.activation) * unit, op.activation, frac_bits)


class _Bank:
    """The filters of one sensor in whole numbers, on planes (1, 4 S^2, H, W)."""

    def __init__(self, vector: tuple[float, ...], scale: int) -> None:
        bank = bank_of_vector(vector)
        self.unit, self.gain = bank.unit, gain_of(bank)
        whole = whole_bank(bank, scale, self.gain)
        self._weight = torch.from_numpy(whole.weight.astype(np.float32) * np.float32(2.0**-whole.frac_bits))
        self._bias = torch.from_numpy((whole.offsets + 0.5).astype(np.float32))

    def __call__(self, planes: Tensor) -> Tensor:
        return functional.conv2d(planes, self._weight, self._bias).floor().clamp(-128, 127)


_bank = lru_cache(maxsize=512)(_Bank)


def family_batches(scenes: list[Scene], seed: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Endless batches of degraded patches, their references without noise, and the vectors of their sensors."""
    like, reference = load_sensor(LIKE), load_sensor(REFERENCE)
    clean = reference.replace(snr_0=CLEAN_SNR[0], snr_1=CLEAN_SNR[1])
    recipe = PatchRecipe(like, clean, PATCH_PX, family=SensorFamily(like.nominal()))
    return PatchSource(scenes, recipe, BATCH, seed).batches()


def train_body(body: IntCore, batches: Iterator[tuple[np.ndarray, ...]], steps: int, log: Log = no_log) -> IntCore:
    """The body after so many steps of Adam, whose rate falls as a half cosine; the loss is the mean PSNR of patches.

    Args:
        body: of a family, which reads a bank's results and planes of a sensor's values.
        batches: of `family_batches`.
        steps: how many.
        log: is told the PSNR now and then.
    """
    trainable = TrainableBody(body)
    optimiser = torch.optim.Adam(trainable.parameters())
    found = list[float]()
    for step, (degraded, reference, vectors) in zip(range(steps), batches, strict=False):
        rate = RATE * min(1, (step + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.param_groups[0]["lr"] = rate
        optimiser.zero_grad()
        error = trainable.restored(degraded, vectors) - torch.from_numpy(reference)
        loss = 10 * torch.log10(error.square().mean((1, 2, 3)) + LEAST_ERROR).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        found.append(-loss.item())
        if (step + 1) % LOG_EVERY == 0:
            log(f"fine-tuning, step {step + 1} of {steps}: {np.mean(found[-LOG_EVERY:]):.2f} dB on what it saw")
    return trainable.core()
