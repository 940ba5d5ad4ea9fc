"""Compare the noise and blur measured in an image with those in a sensor profile.

A measurement contradicts the profile if its 95 % interval is off by more than a factor
(`NOISE_FACTOR`, `BLUR_FACTOR`). Texture without edges has no measurable blur, and a scene without
even ground has no measurable noise. In these cases nothing is contradicted.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from beers_deploy.model.metrics.edge_blur import AxisMtf
from beers_deploy.model.metrics.instrument import AXES, axis_mtfs, snr
from beers_deploy.model.metrics.noise_blocks import ROUNDING, Blocks
from beers_deploy.model.metrics.noise_line import SEED, NoiseModel
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.simulator.acquire import NOISE, acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST
from beers_deploy.profiles.sensor import Sensor

DRAWS = 20
"""Number of sensors drawn from a profile with ranges."""
NOISE_FACTOR = 1.25
BLUR_FACTOR = 1.15
"""The factors of the noise's variance (NOISE_FACTOR) and of the MTF (BLUR_FACTOR)."""
SMOOTH = 0.45
QUIET_PERCENT = 10.0
"""A filter was applied if this percentage of the blocks has less than the share SMOOTH of the
stated variance of the noise.

By chance the quietest blocks have 0.6 of it.
"""
EDGE_PX = 80
OVERSAMPLING = 4
"""The side of the part of a simulated edge that is measured, and the number of scene pixels along
a pixel.
"""
FILTERED = ": restored, resampled or compressed before, or of another gain"
SNR = "measured SNR"


def mtf_name(axis: str) -> str:
    """Return the name under which results show the measured MTF.

    Args:
        axis: "across" or "along" the track.
    """
    return f"measured MTF {axis}"


class StatedSensor(NamedTuple):
    """The noise and blur that a sensor's profile states, in the pixel values of one image.

    Attributes:
        instruments: the nominal sensor first, then sensors drawn from the profile's ranges; the
            nominal one alone if the profile states no ranges.
        unit: the pixel value of one digital number of the sensor.
        edge_mtf: the MTF at Nyquist that edges show behind a whole MTF or a point-spread function,
            for each axis; empty if the profile states contrasts at Nyquist alone.
    """

    instruments: Sequence[Instrument]
    unit: float
    edge_mtf: Mapping[str, float] = {}

    @classmethod
    def of(cls, sensor: Sensor, clipped_at: float) -> "StatedSensor":
        """Prepare a profile for comparison with an image.

        Args:
            sensor: the sensor's profile.
            clipped_at: the pixel value that is the sensor's largest digital number.
        """
        generator = np.random.default_rng(SEED)
        nominal = sensor.nominal()
        samples = (sensor.draw(generator) for _ in range(DRAWS))
        others = (sample for sample in samples if sample != nominal)
        edge_mtf = dict[str, float]()
        if nominal.response is not None:
            # A fit of 17 x 17 pixels cannot show the far tails of a blur: with 30 % of the light in
            # a halo of 4 px, a contrast of 6 % looks like 2.2 % (measured). A simulated edge shows
            # what the fit of an image would.
            full_scale = nominal.max_dn / nominal.gain_dn_per_radiance
            scene = slanted_edge(3 * EDGE_PX, OVERSAMPLING, 5, (full_scale / 10, full_scale / 2))
            skip = (*NOISE, *nominal.effects)
            windows = [
                acquire(
                    prepare_scene(each, OVERSAMPLING),
                    nominal,
                    Draw(0),
                    margin_px=EDGE_PX,
                    skip=skip,
                )
                for each in (scene, scene.T)
            ]
            blurs = axis_mtfs(windows, cls([nominal], 1).nominal_noise, nominal.max_dn)
            edge_mtf = {
                axis: blur.mtf_nyquist for axis, blur in blurs.items() if isinstance(blur, AxisMtf)
            }
        return cls([nominal, *others], clipped_at / nominal.max_dn, edge_mtf)

    def variances(self, value: np.ndarray | float) -> np.ndarray:
        """Return the variance of the noise of each instrument, without that of rounding.

        Args:
            value: pixel values of any shape.

        Returns:
            The variances in squared pixel values, with one more axis in front: the instruments.
        """
        values = np.asarray(value, np.float64)
        return np.stack([self.variance(instrument, values) for instrument in self.instruments])

    def variance(self, sensor: Instrument, value: np.ndarray) -> np.ndarray:
        """Return the variance of the noise of one instrument, without that of rounding.

        Args:
            sensor: the instrument.
            value: pixel values of any shape.

        Returns:
            The variances in squared pixel values, of the same shape.
        """
        gain = sensor.gain_dn_per_radiance
        radiance = np.maximum(value / self.unit - sensor.offset_dn, 0) / gain
        return np.asarray((sensor.alpha * radiance + sensor.beta) * (gain * self.unit) ** 2)

    def nominal_noise(self, values: np.ndarray) -> np.ndarray:
        """Return the variance of the noise of the nominal sensor, rounding to integers included.

        Args:
            values: pixel values of any shape.

        Returns:
            The variances in squared pixel values, of the same shape.
        """
        return self.variance(self.instruments[0], values) + ROUNDING

    def mtf(self, axis: str) -> tuple[float, float]:
        """Return the lowest and the highest MTF at Nyquist of the instruments.

        Args:
            axis: "across" or "along" the track.

        Returns:
            Two shares of the contrast at frequency 0.
        """
        f = np.array([[NYQUIST]]), np.array([[0.0]])
        fx, fy = f if axis == AXES[0] else f[::-1]
        contrasts = [
            abs(complex(sensor_mtf(fx, fy, instrument).item())) for instrument in self.instruments
        ]
        return min(contrasts), max(contrasts)


def compare_noise(
    line: NoiseModel | Refusal, blocks: Blocks, stated: StatedSensor
) -> tuple[Figure, list[str]]:
    """Compare the noise measured in one band of an image with that of the sensor's profile.

    Args:
        line: the noise measured as a function of the pixel value, or the reason why it cannot be
            measured.
        blocks: the blocks of the image in which noise was measured.
        stated: the noise that the profile states.

    Returns:
        The SNR in the middle of the measured pixel values, and a list of one sentence if the noise
        contradicts the profile, else an empty list.
    """
    if isinstance(line, Refusal):
        return unavailable("ratio", line.reason), _smoothed(blocks, stated)
    # The geometric mean of the two limits is the middle of the measured levels.
    value = math.sqrt(math.prod(line.measured_dn))
    variance = line.at(value)
    expected = stated.variances(value)
    nominal = stated.instruments[0]
    signal = max(value - stated.unit * nominal.offset_dn, 0)
    radiance = signal / (stated.unit * nominal.gain_dn_per_radiance)
    ratio, interval = snr(signal, variance)
    stated_snr = signal / math.sqrt(expected[0]) if expected[0] > 0 else math.inf
    source = (
        f"at {radiance:.3g} W/m2/sr/um, {line.blocks} blocks of 16 x 16; the sensor profile states "
        f"{stated_snr:.3g}"
    )
    figure = measured(ratio, "ratio", source, interval)
    low, high = variance.interval
    if low <= expected.max() * NOISE_FACTOR and high >= expected.min() / NOISE_FACTOR:
        return figure, _smoothed(blocks, stated)
    contradiction = (
        f"noise at {radiance:.3g} W/m2/sr/um looks like SNR {ratio:.3g}, but the sensor profile "
        f"states {stated_snr:.3g}"
    )
    return figure, [f"{contradiction}{FILTERED}" if ratio > stated_snr else contradiction]


def _smoothed(blocks: Blocks, stated: StatedSensor) -> list[str]:
    """Return a sentence if the pixels have less noise than any image of the sensor."""
    if not blocks.mean.size:
        return []
    expected = stated.variances(blocks.mean).min(0)
    share = float(np.percentile(blocks.fine / (expected + ROUNDING), QUIET_PERCENT))
    if share > SMOOTH:
        return []
    return [f"the image has {share:.0%} of the noise that the sensor profile states{FILTERED}"]


def compare_blur(
    axis: str, blur: AxisMtf | Refusal, stated: StatedSensor
) -> tuple[Figure, list[str]]:
    """Compare the MTF at Nyquist that edges of the image show with that of the profile.

    Args:
        axis: "across" or "along" the track.
        blur: the measured MTF along the axis, or the reason why there is none.
        stated: the MTF that the profile states.

    Returns:
        The measured MTF in %, and a list of one sentence if it contradicts the profile, else an
        empty list.
    """
    if isinstance(blur, Refusal):
        return unavailable("%", blur.reason), []
    low, high = blur.interval
    figure = measured(100 * blur.mtf_nyquist, "%", f"{blur.edges} edges", (100 * low, 100 * high))
    least, most = stated.mtf(axis)
    on_edge = stated.edge_mtf.get(axis, least)
    # Few and soft edges do not show the shape of the curve, so the MTF by the profile's own shape
    # must be off as well.
    if (
        min(low, blur.nearest) <= max(most, on_edge) * BLUR_FACTOR
        and max(high, blur.nearest) >= min(least, on_edge) / BLUR_FACTOR
    ):
        return figure, []
    bound = most if low > most else least
    contradiction = (
        f"MTF {axis} the track looks like {blur.mtf_nyquist:.2%}, but the sensor profile states "
        f"{bound:.2%}"
    )
    return figure, [contradiction]
