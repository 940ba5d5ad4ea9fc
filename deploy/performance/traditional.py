"""The traditional pipeline on this processor: measured on crops of an image, extrapolated by the
pixel.
"""

import statistics
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from beers_deploy.model.simulator.acquire import scene_side_px, simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.traditional.pipeline import TraditionalPipeline, restore_traditional
from beers_deploy.performance.host import conditions_of
from beers_deploy.performance.swath import Swath, efficiency, pipeline_rate
from beers_deploy.performance.tables import TABLE
from beers_deploy.performance.timing import cpu_load, load_of_others, own_cpu_s, timed
from beers_deploy.profiles.figures import Figure, Row, measured, predicted
from beers_deploy.profiles.sensor import Sensor

CROP_PX = 256
CROPS = 3


@dataclass(frozen=True)
class PipelineTime:
    """The measured time and power of the traditional pipeline on this machine.

    Attributes:
        s_per_mpx: the time of each crop in s for 10^6 pixels.
        power: the mean power of this processor in W while the pipeline ran.
        conditions: the figures "threads" and "CPU load".
        crop: the size of the crops in words, for the source of the figures.
        others: the share of all CPUs in [0, 1] that other processes used meanwhile.
    """

    s_per_mpx: list[float]
    power: Figure
    conditions: dict[str, Figure]
    crop: str
    others: float

    def row(self, swath: Swath) -> Row:
        """Predict the pipeline's figures for a whole image on this machine, as a row of `bench`.

        The time is that of the median crop, scaled by the pixels of all bands. Its interval reaches
        from the fastest to the slowest crop.
        """
        median = statistics.median(self.s_per_mpx)
        mpx = swath.band_pixels / 1e6
        here = f"{len(self.s_per_mpx)} crops of {self.crop} on this processor, the default quality"
        ends = mpx * min(self.s_per_mpx), mpx * max(self.s_per_mpx)
        latency = predicted(mpx * median, "s", ends, f"by the pixel from {here}")
        figures = {
            "time": measured(median, "s/Mpx", f"median of {here}"),
            "latency": latency,
            "throughput": pipeline_rate(swath, latency),
            "power": self.power,
            "efficiency": efficiency(swath.pixels, latency, self.power),
            **self.conditions,
        }
        return Row(TABLE, "traditional pipeline on this CPU", figures)


def measure_pipeline(dn: np.ndarray, degraded: Sensor, reference: Sensor) -> PipelineTime:
    """Time the traditional pipeline (denoise, then deconvolve) on CROPS crops of an image.

    A small run for warm-up is not counted.

    Args:
        dn: the image in digital numbers (H, W).
        degraded: the sensor that acquired the image.
        reference: the better sensor that is the target of the deconvolution.
    """
    pipeline = TraditionalPipeline(degraded.nominal(), reference.nominal())
    height, width = (min(CROP_PX, side) for side in dn.shape)
    crops = []
    # Square crops along the image's diagonal, or the image if it is not larger.
    for k in range(CROPS):
        top, left = (
            (side - crop) * k // (CROPS - 1)
            for side, crop in zip(dn.shape, (height, width), strict=True)
        )
        crop = np.ascontiguousarray(dn[top : top + height, left : left + width], np.float32)
        crops.append(torch.from_numpy(crop))
    restore_traditional(crops[0][:32, :32], pipeline)
    # The load is measured from one call to the next: this one opens the window of the timed run.
    cpu_load()
    before_s = own_cpu_s()
    times_s, elapsed_s, power = timed(
        lambda: [timed(partial(restore_traditional, crop, pipeline))[1] for crop in crops]
    )
    per_mpx = [1e6 * time_s / crop.numel() for time_s, crop in zip(times_s, crops, strict=True)]
    own_s = own_cpu_s() - before_s
    conditions = conditions_of(torch.get_num_threads())
    others = load_of_others(conditions["CPU load"], own_s, elapsed_s)
    return PipelineTime(per_mpx, power, conditions, f"{width} x {height} pixels", others)


def drawn_acquisition(
    swath: Swath, degraded: Sensor, reference: Sensor, seed: int = 0
) -> np.ndarray:
    """Simulate an image to time the pipeline on, if the user gives none.

    Args:
        swath: the image that the benchmark describes. The result is as large, but not larger than
            the crops of `measure_pipeline` need.
        degraded: the sensor of the image.
        reference: the better sensor, which the simulator needs for a pair.
        seed: the seed of the scene and of the noise.

    Returns:
        Digital numbers (H, W).
    """
    ratio = int(degraded.oversampling.low)
    sides = min(swath.height_px, CROP_PX), min(swath.width_px, CROPS * CROP_PX)
    height, width = (scene_side_px(side, ratio) for side in sides)
    scene = procedural_scene(height, width, np.random.default_rng(seed))
    pair = simulate_pair(scene.radiance, degraded.nominal(), reference.nominal(), ratio, Draw(seed))
    return pair.degraded
