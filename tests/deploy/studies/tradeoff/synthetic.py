"""Points with figures that were made up, on a real board."""

from collections.abc import Sequence

import numpy as np
import onnx

from beers_deploy.dpu.board import load_dpu
from beers_deploy.network import Network
from beers_deploy.profiles.figures import measured, predicted
from beers_deploy.studies.tradeoff.front import Comparison, Measured
from beers_deploy.studies.tradeoff.points import INT8, Point, Variant

SITES = ("a", "a", "b", "c", "d", "e")
DIFFICULTY_DB = np.array([0.0, 1.0, -6.0, 5.0, -2.0, 2.0])
"""How sites differ: by far more than methods do."""
COMPARE = Comparison(SITES, 0)
DPU = load_dpu("vck190")


def synthetic(
    name: str,
    psnr_db: float,
    latency_s: float,
    *,
    scatter_db: float = 0.01,
    tile_px: int = 640,
    method: str = "",
    board: str = "vck190",
    power_w: float = 30.0,
) -> Measured:
    """Make an INT8 network of that name: its scores differ from the mean as sites do, and by some
    scatter.
    """
    noise = np.random.default_rng(sum(map(ord, name))).normal(size=len(SITES))
    values = psnr_db + DIFFICULTY_DB - DIFFICULTY_DB.mean() + scatter_db * (noise - noise.mean())
    network = Network(onnx.ModelProto(), method or name)
    variant = Variant(method or name, INT8, network)
    return Measured(
        name,
        {
            "PSNR": measured(psnr_db, "dB", "made up", (psnr_db - 3, psnr_db + 3)),
            "SSIM": measured(psnr_db / 50, "ratio", "made up"),
            "host p50": measured(latency_s / 10, "s/Mpx", "made up"),
            "board latency": predicted(
                latency_s, "s", (latency_s / 1.6, latency_s * 1.6), "made up"
            ),
            "board power": predicted(power_w, "W", (power_w / 2, power_w * 2), "made up"),
            "board energy": predicted(
                latency_s * power_w, "J", (latency_s * 15, latency_s * 60), "made up"
            ),
        },
        {
            "board": board,
            "configuration": DPU.name,
            "tile": "640",
            "halo": "exact",
            "method": name,
            "sensor": "known",
        },
        Point(variant, DPU.target, DPU, tile_px),
        [{"PSNR": float(value), "SSIM": float(value) / 50} for value in values],
    )


def family() -> Sequence[Measured]:
    """Small to large: each better and dearer, the last two alike, and one that is beaten."""
    return [
        synthetic("tiny", 44.0, 0.6),
        synthetic("small", 45.0, 2.0),
        synthetic("medium", 45.5, 4.0),
        synthetic("large", 45.503, 30.0, scatter_db=0.05),
        synthetic("slow", 44.5, 9.0),
    ]
