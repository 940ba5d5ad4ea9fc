"""Families of networks that a DPU could like, each trained with equal effort: what they restore,
and predicted time.

    python benchmarks/families.py --images aerial/ --out families/ \
        [--families 4x64@2,u48@2] [--steps 1000]
                                  [--device cuda]

Each is trained from scratch for one sensor, which it is not told, on as many patches as any other,
and judged on the sites that training keeps apart: PSNR in float32 and in INT8 (calibrated on drawn
scenes), and predicted seconds of a swath of 13600 x 9016 with exact seams on a VCK190, each with
its best tile and configuration. Weights go to the folder; a network whose weights lie there is not
trained again.

Names: BLOCKSxFEATURES as the paper's blocks, uFEATURES a U-Net of two levels, dBLOCKSxFEATURES
blocks of a widening 1 x 1, a depthwise 5 x 5 and a narrowing 1 x 1 convolution, kBLOCKSxFEATURES
blocks of 5 x 5 convolutions, aBLOCKSxFEATURES the paper's blocks with dilated convolutions in the
middle ones, wBLOCKSxFEATURES blocks four times as wide inside, bBLOCKSxFEATURES the paper's blocks
and beside them half as many at half the resolution; @SCALE: at 1 / SCALE of the resolution. The
last three see farther or say more at equal time. What a family is worth in the end, longer training
tells: `beers-deploy train`.
"""

import argparse
import re
import time
from collections.abc import Callable, Iterable
from itertools import islice, product
from pathlib import Path

import numpy as np
import onnx
import torch
from safetensors.torch import load_file, save_file
from shapes import on_a_swath
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from beers_deploy.dpu.board import load_dpu
from beers_deploy.model.convbeers import ResidualBlock
from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.model.processor import processor_name
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import list_images, site_of
from beers_deploy.model.simulator.sampling import read_scene
from beers_deploy.model.training.losses import LossWeights, RestorationLoss
from beers_deploy.model.training.patches import PatchRecipe
from beers_deploy.model.training.source import PatchSource
from beers_deploy.network import Network
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.calibration import Calibration, draw_patches
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples import Patches
from beers_deploy.quant.tiling.walk import tiling_of

FAMILIES = "4x64@2,8x48@2,2x32@2,u48@2,u64@2,d8x64@2,d8x96@2,k2x32@2,k3x48@2,u32,8x32"
NAME = re.compile(r"(?P<kind>[udkawb]?)(?:(?P<blocks>\d+)x)?(?P<features>\d+)(?:@(?P<scale>\d+))?")
CORRECTIONS = ("second", "project", "tail", "end")
"""What is added to something else starts small, so that a network starts near the identity."""
SENSOR = "pleiades-degraded"
REFERENCE = "pleiades-reference"
BATCH = 16
PATCH_PX = 64
RATE = 5e-4
HELD_OUT_EVERY = 4
"""Of so many sites one is not trained on."""
HELD_OUT = 64
"""Patches of 128 x 128 that all are judged by."""
CONFIGURATIONS = ("C32B6", "C64B5")
TILES_PX = (128, 176, 256, 320, 640)
LOSS = RestorationLoss(LossWeights(lpips=0.0, fft=0.0))


class Restoring(nn.Module):
    """Image plus correction, (N, 1, H, W) to the same: a head, a body between maps of equal size, a
    tail.
    """

    def __init__(self, features: int, scale: int, body: nn.Module) -> None:
        super().__init__()
        self.scale = scale
        self.body = body
        self.head = conv(scale**2, features)
        self.tail = conv(features, scale**2)

    def forward(self, image: Tensor) -> Tensor:
        """Restore images."""
        shallow = self.head(pixel_unshuffle(image, self.scale) if self.scale > 1 else image)
        correction: Tensor = self.tail(shallow + self.body(shallow))
        return image + (pixel_shuffle(correction, self.scale) if self.scale > 1 else correction)


def wide_block(features: int) -> ResidualBlock:
    """A residual block of 5 x 5 convolutions."""
    block = ResidualBlock(features)
    block.first, block.second = (conv(features, features, 5) for _ in range(2))
    return block


class Depthwise(nn.Module):
    """x + a narrowing of what is filtered channel by channel, twice as wide as x."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.expand = conv(features, 2 * features, 1)
        self.project = conv(2 * features, features, 1)
        self.depthwise = nn.Conv2d(2 * features, 2 * features, 5, padding=2, groups=2 * features)

    def forward(self, x: Tensor) -> Tensor:
        """(N, F, H, W) to the same."""
        correction: Tensor = self.project(torch.relu(self.depthwise(torch.relu(self.expand(x)))))
        return x + correction


def dilated_blocks(blocks: int, features: int) -> Iterable[nn.Module]:
    """Residual blocks whose first convolution reaches twice or four times as far in the middle."""
    for number in range(blocks):
        block = ResidualBlock(features)
        distance = min(number, blocks - 1 - number)
        reach = (1, 2, 4)[min(distance, 2)]
        block.first = nn.Conv2d(features, features, 3, padding=reach, dilation=reach)
        yield block


def widening_block(features: int) -> ResidualBlock:
    """A residual block four times as wide inside (WDSR, Yu et al. 2018)."""
    block = ResidualBlock(features)
    block.first = conv(features, 4 * features)
    block.second = conv(4 * features, features)
    return block


class Beside(nn.Module):
    """What is given, the paper's blocks of it, and half as many blocks at half the resolution,
    added up.
    """

    def __init__(self, blocks: int, features: int) -> None:
        super().__init__()
        self.fine = nn.Sequential(
            *(ResidualBlock(features) for _ in range(blocks)), conv(features, features)
        )
        self.down = nn.Conv2d(features, features, 3, stride=2, padding=1)
        self.coarse = nn.Sequential(*(ResidualBlock(features) for _ in range(blocks // 2)))
        self.end = conv(features, 4 * features)

    def forward(self, x: Tensor) -> Tensor:
        """(N, F, H, W) of even sides to the same."""
        coarse = pixel_shuffle(self.end(self.coarse(torch.relu(self.down(x)))), 2)
        correction: Tensor = self.fine(x) + coarse
        return correction


class Levels(nn.Module):
    """A block, two more at half the resolution with twice the features, and a block; the skip is
    added.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.before = ResidualBlock(features)
        self.after = ResidualBlock(features)
        self.down = nn.Conv2d(features, 2 * features, 3, stride=2, padding=1)
        self.deep = nn.Sequential(*(ResidualBlock(2 * features) for _ in range(2)))
        self.up = nn.ConvTranspose2d(2 * features, features, 2, stride=2)
        self.end = conv(features, features)

    def forward(self, x: Tensor) -> Tensor:
        """(N, F, H, W) of even sides to the same."""
        shallow = self.before(x)
        deep = self.up(self.deep(torch.relu(self.down(shallow))))
        correction: Tensor = self.end(self.after(shallow + deep))
        return correction


def conv(inputs: int, outputs: int, kernel: int = 3) -> nn.Conv2d:
    """A convolution that keeps the size."""
    return nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)


def build(name: str, generator: torch.Generator) -> Restoring:
    """The network of that name, with weights drawn from the generator."""
    match = NAME.fullmatch(name)
    if match is None:
        raise SystemExit(f"expected names such as {FAMILIES}, got {name!r}")
    blocks, features, scale = (int(match[part] or 1) for part in ("blocks", "features", "scale"))
    kinds: dict[str, Callable[[], Iterable[nn.Module]]] = {
        "": lambda: [*(ResidualBlock(features) for _ in range(blocks)), conv(features, features)],
        "k": lambda: [*(wide_block(features) for _ in range(blocks)), conv(features, features)],
        "d": lambda: [*(Depthwise(features) for _ in range(blocks)), conv(features, features)],
        "u": lambda: [Levels(features)],
        "a": lambda: [*dilated_blocks(blocks, features), conv(features, features)],
        "w": lambda: [*(widening_block(features) for _ in range(blocks)), conv(features, features)],
        "b": lambda: [Beside(blocks, features)],
    }
    network = Restoring(features, scale, nn.Sequential(*kinds[match["kind"]]()))
    for path, module in network.named_modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            small = 0.1 if path.endswith((*CORRECTIONS, f"body.{blocks}")) else 1.0
            fan_in = (
                module.weight[0].numel() if isinstance(module, nn.Conv2d) else module.in_channels
            )
            with torch.no_grad():
                module.weight.normal_(0.0, small * (2 / fan_in) ** 0.5, generator=generator)
                module.bias.zero_()  # type: ignore[union-attr]
    return network


def trained(name: str, source: PatchSource, count: int, path: Path, device: str) -> Restoring:
    """The network after so many steps by Adam, L1, the rate falling to 0 as a half cosine; kept in
    `path`.
    """
    network = build(name, torch.Generator().manual_seed(0))
    if path.exists():
        network.load_state_dict(load_file(path))
        return network.eval()
    network.to(device)
    optimiser = torch.optim.Adam(network.parameters(), RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, count)
    begun = time.process_time()
    with steps(f"training {name}", count) as bar:
        for batch in islice(source.batches(), count):
            loss, _ = LOSS(network(batch.degraded), batch.reference)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 0.1)
            optimiser.step()
            falling.step()
            bar.advance()
    print(f"{name}: trained in {time.process_time() - begun:.0f} s of processor time", flush=True)
    network.cpu()
    save_file(network.state_dict(), path)
    return network.eval()


def psnr_cell(model: onnx.ModelProto, patches: Patches) -> str:
    """Mean PSNR of the patches, dB over full scale."""
    restore = Network.load(model)
    levels = [
        psnr_db(restore(degraded)[0, 0].clip(0, 1), reference[0, 0], 1.0)
        for degraded, reference in patches.pairs
    ]
    return f"{np.mean(levels):.2f}"


def swath_cell(model: onnx.ModelProto) -> str:
    """Predicted seconds of a swath, with interval, tile and configuration, where they are least."""
    seconds = []
    for configuration, tile_px in product(CONFIGURATIONS, TILES_PX):
        if 2 * tiling_of(model).halo_px < tile_px:
            _, time_s, low_s, high_s = on_a_swath(model, load_dpu("vck190", configuration), tile_px)
            seconds.append(
                (time_s, f"{time_s:.3g} [{low_s:.3g}, {high_s:.3g}] ({tile_px}, {configuration})")
            )
    return min(seconds)[1]


def main() -> None:
    """Print a row a family."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--families", default=FAMILIES)
    parser.add_argument("--steps", type=int, default=1000, help=f"of {BATCH} patches")
    parser.add_argument("--device", default="cpu", help="cpu or cuda, of the training")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    sensors = Sensor.load(SENSOR), Sensor.load(REFERENCE)
    scenes = [read_scene(file, sensors[1].nominal()) for file in list_images(arguments.images)]
    held_out_sites = sorted({site_of(scene.name) for scene in scenes})[::HELD_OUT_EVERY]
    held_out = [scene for scene in scenes if site_of(scene.name) in held_out_sites]
    training = [scene for scene in scenes if site_of(scene.name) not in held_out_sites]
    judging = draw_patches(held_out, *sensors, HELD_OUT, 1)
    source = PatchSource(
        training, PatchRecipe(*sensors, patch_px=PATCH_PX), BATCH, 0, device=arguments.device
    )
    patches = Calibration(Sensor.load(SENSOR), None, 64, 128, 0).drawn
    print(
        f"{processor_name()}, {arguments.steps * BATCH} patches each, judged by {HELD_OUT} of "
        f"{len(held_out_sites)} sites"
    )
    heads = "family", "1000 parameters", "halo, px", "float32 dB", "INT8 dB", "s a swath, best tile"
    print("|", " | ".join(heads), "|\n" + "|---" * len(heads) + "|")
    for name in arguments.families.split(","):
        weights_file = arguments.out / f"{name}.safetensors"
        network = trained(name, source, arguments.steps, weights_file, arguments.device)
        model = Network.load(network).model
        int8 = quantize_model(model, patches, {}).host
        scores = [psnr_cell(network, judging) for network in (model, int8)]
        weights = sum(parameter.numel() for parameter in network.parameters()) / 1e3
        cells = [name, f"{weights:.0f}", str(tiling_of(int8).halo_px), *scores, swath_cell(int8)]
        print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
