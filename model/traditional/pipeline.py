"""Restore an image by the two traditional pipelines. Every parameter derives from the two sensors
and from the image.

- denoise first: stabilise, NL-Bayes, inverse, MTF compensation. NL-Bayes sees the white noise that
  it assumes; the residual noise is amplified afterwards.
- deconvolve first: MTF compensation, stabilise, NL-Bayes, inverse. The noise that NL-Bayes sees is
  amplified and coloured by the filter, and it is given the colour.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from beers_deploy.model.simulator.detector import to_dn, to_radiance
from beers_deploy.model.traditional.compensate import compensation_kernel, filter_strips
from beers_deploy.model.traditional.nl_bayes import finite_or_missing, nl_bayes_strips
from beers_deploy.model.traditional.noise import (
    Noise,
    bias_radiance,
    coloured_by,
    destabilise,
    stabilise,
    with_rounding_noise,
)
from beers_deploy.model.traditional.patch_groups import QUALITIES, Quality
from beers_deploy.model.traditional.regularisation import derived_epsilon, measure
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.instrument import Instrument

WORKING_SIGMA = 12.0
"""Noise level at which NL-Bayes runs: the stabilised image is scaled to it, where the published
settings apply.

6, 9 and 18 lose 0.05, 0.05 and 0.02 dB, and 25 gains 0.02 dB, all of it in the dark (measured:
means of 120 images of five training photographs under four sensors at three brightnesses).
"""

Order = Literal["denoise-first", "deconvolve-first"]


@dataclass(frozen=True)
class TraditionalPipeline:
    """The parameters of a traditional restoration: denoising by NL-Bayes and MTF compensation,
    without a network.

    It converts images of `degraded` to those that `reference` would have acquired without its
    noise.

    Attributes:
        degraded: the instrument that acquired the images.
        reference: the instrument that the restoration aims at.
        quality: "fast", "standard" or "best", a compromise between time and quality of NL-Bayes.
        order: whether denoising or MTF compensation, a deconvolution, comes first.
        epsilon: strength of the regularisation of the MTF compensation. None derives it from each
            image: by `restore_traditional`, or by `fitted_to` for an image in strips.
    """

    degraded: Instrument
    reference: Instrument
    quality: str = "standard"
    order: Order = "denoise-first"
    epsilon: float | None = None

    def fitted_to(self, strips: Iterable[Tensor]) -> "TraditionalPipeline":
        """Return the pipeline with the epsilon that suits the noise and the contrast of an image.

        A pipeline that has an epsilon is returned unchanged, and no strip is read.

        Args:
            strips: the image as strips (rows, W) of digital numbers, NaN where missing.

        Raises:
            ImageError: a pixel is infinite.
        """
        if self.epsilon is not None:
            return self
        noise_and_scene = measure(finite_or_missing(strips), self.degraded)
        return replace(self, epsilon=derived_epsilon(noise_and_scene, self.degraded))

    def kernel(self) -> Tensor:
        """Return the filter of the MTF compensation, (2 R + 1, 2 R + 1) float64.

        Raises:
            OptionError: the pipeline has no epsilon.
        """
        if self.epsilon is None:
            raise OptionError(
                "The pipeline has no epsilon yet. Call TraditionalPipeline.fitted_to with the "
                "strips of the image first."
            )
        return compensation_kernel(self.degraded, self.reference, self.epsilon)


def restore_traditional(dn: Tensor, pipeline: TraditionalPipeline) -> Tensor:
    """Restore digital numbers (H, W) float32 of the degraded sensor to those of the reference.

    The result is clipped and not rounded. NaN marks missing pixels, and remains.

    Args:
        dn: the digital numbers of the image.
        pipeline: the two sensors and the parameters; an epsilon is derived from the image if it has
            none.

    Raises:
        ImageError: a pixel is infinite.
    """
    return torch.cat(list(restore_strips([dn], dn.shape[0], pipeline.fitted_to([dn]))))


def restore_strips(
    strips: Iterable[Tensor], height: int, pipeline: TraditionalPipeline
) -> Iterator[Tensor]:
    """Restore an image that arrives in strips of rows, with the same bits as `restore_traditional`.

    The strips are read only once. Some 700 rows of the image, and the tallest strip, are held in
    memory.

    Args:
        strips: digital numbers of the degraded sensor from top to bottom, in strips (any, W); NaN
            where missing.
        height: the number of rows of all strips.
        pipeline: the two sensors and the parameters, with an epsilon.

    Yields:
        Digital numbers of the reference, in strips (any, W).

    Raises:
        ImageError: a pixel is infinite.
        OptionError: the pipeline has no epsilon, which `TraditionalPipeline.fitted_to` derives.
    """
    radiance = (to_radiance(strip, pipeline.degraded) for strip in finite_or_missing(strips))
    # The converter's rounding adds a twelfth of a squared DN, which NL-Bayes must include.
    sensor = with_rounding_noise(pipeline.degraded)
    kernel = pipeline.kernel()
    quality = QUALITIES[pipeline.quality]
    if pipeline.order == "denoise-first":
        clean = denoise_radiance(radiance, height, sensor, Noise(WORKING_SIGMA), quality)
        restored = filter_strips(clean, height, kernel)
    else:
        coloured = coloured_by(kernel, 1.0)
        # The filter multiplies the variance of white noise by the sum of its squares.
        amplified = replace(
            sensor, alpha=sensor.alpha * coloured.sigma**2, beta=sensor.beta * coloured.sigma**2
        )
        sharp = filter_strips(radiance, height, kernel)
        restored = denoise_radiance(
            sharp, height, amplified, replace(coloured, sigma=WORKING_SIGMA), quality
        )
    for strip in restored:
        yield to_dn(strip, pipeline.reference)


def denoise_radiance(
    radiance: Iterable[Tensor], height: int, sensor: Instrument, noise: Noise, quality: Quality
) -> Iterator[Tensor]:
    """Denoise an image in radiance with NL-Bayes, on the scale of `stabilise` on which the noise is
    equal everywhere.

    Args:
        radiance: strips (any, W) in W/m2/sr/um with noise of the variance alpha L + beta.
        height: the number of rows of all strips.
        sensor: the instrument that states alpha and beta.
        noise: the noise that NL-Bayes removes. The stabilised image, whose noise is 1, is
            multiplied by its sigma first.
        quality: density of the reference patches and size of their groups.

    Yields:
        The denoised image in strips (any, W) in W/m2/sr/um.
    """
    scale = noise.sigma
    stable = (stabilise(strip, sensor) * scale for strip in radiance)
    for clean in nl_bayes_strips(stable, height, noise, quality):
        # The root is concave: a mean on the stabilised scale lies alpha / 4 too low.
        yield destabilise(clean / scale, sensor) + bias_radiance(sensor)
