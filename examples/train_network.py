"""Train one of the example networks on simulated images. Minutes of training give meaningful
results, but none of the networks is a product.

    python -m examples.train_network unet --steps 2000 --out unet.onnx

`examples.samples` defines the task that each one learns. The script writes FILE.onnx and the
weights as FILE.safetensors next to it, and prints the results on scenes that were not used for
training.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional

from beers_deploy.model.convbeers import arrays
from beers_deploy.model.io.files import require_writable, whole_file
from beers_deploy.model.io.tensors import write_tensors
from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.model.progress import steps
from beers_deploy.profiles.errors import OptionError
from examples.networks import NETWORKS, build, to_onnx
from examples.samples import Batch, batches_of, positive, reported

JUDGED = 16
"""The number of batches on which a trained network is evaluated."""
LEARNING_RATE = 2e-3


def train(name: str, source: Iterator[Batch], count: int, seed: int) -> nn.Module:
    """Train the network of that name with `count` steps of Adam over batches of `source`. Return it
    in evaluation mode.
    """
    network = build(name, torch.Generator().manual_seed(seed))
    error = criterion(name)
    optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, count)
    network.train()
    with steps(name, count) as progress:
        for image, reference in islice(source, count):
            optimiser.zero_grad()
            loss = error(network(image), reference)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            progress.advance(note=f"loss {loss.item():.4f}")
    return network.eval()


def criterion(name: str) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the loss function: the mean absolute error of an image, or the cross entropy of
    classes.
    """
    return functional.l1_loss if NETWORKS[name].restores else functional.cross_entropy


def judge(name: str, network: nn.Module, source: Iterator[Batch]) -> tuple[float, float, str]:
    """Return the quality of the outputs on further batches, the quality without the network, and
    the unit.

    For images it is the PSNR in dB over full scale, compared with that of the input (upsampled
    bilinearly if the network enlarges). For classes it is the percentage of correct pixels,
    compared with that of the most frequent class.
    """
    with torch.inference_mode():
        outcomes = [
            (network(image), image, reference) for image, reference in islice(source, JUDGED)
        ]
    output, image, reference = (torch.cat(tensors) for tensors in zip(*outcomes, strict=True))
    if not NETWORKS[name].restores:
        right = (output.argmax(1) == reference).double().mean()
        return (
            float(100 * right),
            float(100 * reference.flatten().bincount().max() / reference.numel()),
            "% right",
        )
    if image.shape != reference.shape:
        image = functional.interpolate(image, size=reference.shape[-2:], mode="bilinear")
    trained, before = (
        psnr_db(result.numpy(), reference.numpy(), 1.0) for result in (output, image)
    )
    return trained, before, "dB"


def main(arguments: Sequence[str] | None = None) -> int:
    """Train a network, write it, report the result, and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--steps", type=positive, default=2000, metavar="N")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.onnx")
    parser.add_argument(
        "--images",
        type=Path,
        metavar="DIR",
        help="photographs to train on in place of drawn scenes",
    )
    parser.add_argument(
        "--held-out",
        type=Path,
        metavar="DIR",
        help="photographs to judge on in place of drawn scenes",
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    folders = options.images, options.held_out
    return reported(lambda: run(options.network, options.steps, options.out, folders, options.seed))


def run(
    name: str, count: int, out: Path, folders: tuple[Path | None, Path | None], seed: int
) -> None:
    """Train on the images of the first folder, evaluate on those of the second, write both files,
    and print one line.
    """
    if out.suffix != ".onnx":
        raise OptionError(f"--out must be a name that ends in .onnx, got {out.name}.")
    weights = out.with_suffix(".safetensors")
    require_writable(out, weights)
    learnt, judged = (batches_of(name, folder, seed + k) for k, folder in enumerate(folders))
    network = train(name, learnt, count, seed)
    trained, before, unit = judge(name, network, judged)
    write_tensors(
        weights, arrays(network.state_dict()), {"network": name, "steps": count, "seed": seed}
    )
    with whole_file(out) as temporary:
        onnx.save(to_onnx(name, network), temporary)
    sys.stdout.write(
        f"{name}: {trained:.2f} {unit} after {count} steps, {before:.2f} without it (measured): "
        f"{out}\n"
    )


if __name__ == "__main__":
    sys.exit(main())
