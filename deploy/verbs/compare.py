"""Compare a float and an INT8 network on the same samples, for Python: the command is `gate`."""

from typing import TYPE_CHECKING, Annotated, Literal

from beers_deploy.model.shipped import SENSOR
from beers_deploy.verbs.parameters import (
    InputPath,
    Interval,
    NetworkLike,
    Progress,
    Samples,
    Seed,
    SensorLike,
)
from beers_deploy.verbs.verb import path_or_none, refuse_with, verb

if TYPE_CHECKING:
    from beers_deploy.comparison import Comparison


@verb
def compare(
    float_network: NetworkLike | None = None,
    int8_network: NetworkLike | None = None,
    *,
    samples: Samples | None = None,
    sensor: SensorLike = SENSOR,
    images: InputPath | None = None,
    patches: Annotated[int, Interval(ge=1, le=100_000)] = 32,
    seed: Seed = 0,
    metric: Literal["psnr", "ssim", "mae"] | None = None,
    output: str | None = None,
    progress: Progress = None,
) -> "Comparison":
    """Compare a float and an INT8 network on samples that were not used for calibration.

    Args:
        float_network: the float network. The name of a shipped network, or the `Network` that
            `quantize` returned, stands for both networks; None for the shipped convbeers-s.
        int8_network: the INT8 network that was made from it; None if `float_network` stands for
            both.
        samples: a path, arrays or any input that `quantize` accepts; simulated patches if None.
        sensor: the sensor whose images the patches imitate and that shipped networks are
            conditioned on.
        images: folder of scenes to simulate the patches from; None for scenes drawn at random.
        patches: number of simulated patches, 128 x 128 pixels each.
        seed: the seed of the patches.
        metric: psnr, ssim or mae, to also compare each network's results with the references; None
            for no comparison with them.
        output: name of the output to compare, if a network has several.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of the differences. It has no checks: `gate` adds limits.

    Raises:
        ModelError: a file is not a valid network of the expected kind.
        OptionError: there is no INT8 network, the metric is unknown, or images are given together
            with samples.
        ImageError: the networks do not accept the samples.

    Examples:
        >>> table = bd.compare("convbeers-xs", patches=2)
        >>> bool(table.rows[0].figures["MAE"].value < 0.001)  # of full scale
        True
    """
    from beers_deploy.comparison import Data, compared, pair_of
    from beers_deploy.profiles.sensor import Sensor

    if samples is not None:
        refuse_with("`samples`", images=images is not None)
    profile = Sensor.load(sensor)
    floating, int8 = pair_of(float_network, int8_network, profile, output)
    data = Data(profile, samples, path_or_none(images), patches, seed)
    return compared(floating, int8, data, data.own(floating, int8), metric or "")
