"""Fit the inverse of a deviation, by which a normalisation divides, with convolutions and ReLU.

1. The deviation is nearly a sum of the parts above and below the mean, each times a weight of at
   least 0: that of channels with larger outliers is larger.
2. Its inverse is convex and falls, as sums of ReLU(knot - a) times heights of at least 0 do.

Both fits minimise the mean square error of the normalised map (non-negative least squares), so that
pixels and images without contrast do not count: they become 0.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
from scipy.optimize import nnls

from beers_deploy.quant.adapt.compensation import part_values
from beers_deploy.quant.graph.normalization import InverseDeviation, Normalization

KNOTS = 3
"""ReLUs of each inverse. With 6 a small NAFNet loses as much."""
MOST_PIXELS = 20000
"""The maximum number of pixels that a normalisation over channels is fitted to."""
LEAST_VARIANCE = 1e-12
"""The minimum that is added to variances. Without it, maps without contrast would divide by 0."""
SCALINGS = np.geomspace(0.5, 2, 9)
"""Factors of each image's statistics, so that an image of more or less contrast is fitted, too."""


def fit_inverses(
    model: onnx.ModelProto,
    normalizations: Sequence[Normalization],
    images: Sequence[np.ndarray],
) -> Mapping[str, InverseDeviation]:
    """Fit the inverse deviations of the normalisations of a network to images.

    Args:
        model: the network.
        normalizations: its normalisations.
        images: (1, C, H, W) as the network reads them.

    Returns:
        The inverse deviation of each normalisation, by the name of the result.
    """
    if not normalizations:
        return {}
    sources = [each.source for each in normalizations]
    maps = zip(*part_values(model, sources, images), strict=True)
    inverses = {}
    for each, values in zip(normalizations, maps, strict=True):
        fit = _of_pixels if each.is_of_pixels else _of_image
        epsilon = max(each.epsilon, LEAST_VARIANCE)
        inverses[each.last.result] = fit(np.concatenate(values).astype(np.float64), epsilon)
    return inverses


def _of_pixels(values: np.ndarray, epsilon: float) -> InverseDeviation:
    """Fit the inverse deviation of each pixel over the channels of a map.

    Args:
        values: (N, C, H, W) the map in N images.
        epsilon: the number that is added to the variance.
    """
    channels = values.shape[1]
    pixels = np.moveaxis(values, 1, -1).reshape(-1, channels)
    pixels = pixels[:: -(-len(pixels) // MOST_PIXELS)]
    differences = pixels - pixels.mean(1, keepdims=True)
    variances = np.square(differences).mean(1)
    features = np.maximum(np.concatenate([differences, -differences], axis=1), 0)
    weights, knots, heights, floor = _fit(features, variances, epsilon)
    return InverseDeviation(
        unit=np.ones(channels),
        inner_weight=np.tile(weights, (KNOTS, 1)),
        inner_bias=knots,
        weight=np.tile(heights, (channels, 1)),
        bias=np.full(channels, floor),
    )


def _of_image(values: np.ndarray, epsilon: float) -> InverseDeviation:
    """Fit the inverse deviation of each channel of a map over the image.

    Args:
        values: (N, C, H, W) the map in N images.
        epsilon: the number that is added to the variance.
    """
    channels = values.shape[1]
    differences = values - values.mean((2, 3), keepdims=True)
    variances = np.square(differences).mean((2, 3))
    unit = np.sqrt(np.median(variances, axis=0) + epsilon)
    above = np.maximum(differences, 0).mean((2, 3)) / unit
    inner_weight = np.zeros((channels, KNOTS, channels))
    inner_bias = np.zeros((channels, KNOTS))
    weight = np.zeros((channels, channels, KNOTS))
    bias = np.zeros(channels)
    for channel in range(channels):
        features = np.outer(SCALINGS, above[:, channel]).reshape(-1, 1)
        in_units = variances[:, channel] / unit[channel] ** 2
        scaled_variances = np.outer(np.square(SCALINGS), in_units).ravel()
        fitted = _fit(features, scaled_variances, epsilon / unit[channel] ** 2)
        weights, knots, heights, floor = fitted
        inner_weight[channel, :, channel] = weights
        inner_bias[channel] = knots
        weight[channel, channel] = heights
        bias[channel] = floor
    return InverseDeviation(
        unit=unit,
        inner_weight=inner_weight.reshape(-1, channels),
        inner_bias=inner_bias.ravel(),
        weight=weight.reshape(channels, -1),
        bias=bias,
    )


def _fit(
    features: np.ndarray, variances: np.ndarray, epsilon: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Fit the inverse of the deviation as a function of features.

    Args:
        features: (n, F) of n pixels or images, at least 0.
        variances: (n,).
        epsilon: the number that is added to the variance.

    Returns:
        The weights (F,) of the features, the knots (KNOTS,) of their sum a, and the heights
        (KNOTS,) and the floor of

            1 / deviation = sum(heights ReLU(knots - a)) + floor
    """
    deviations = np.sqrt(variances + epsilon)
    normalized = np.sqrt(variances) / deviations
    # 1.
    weights = _non_negative(features * (normalized / deviations)[:, None], normalized)
    # 2.
    typical = deviations[normalized >= normalized.max() / 2]
    low, high = np.percentile(typical, [0.05, 99.95])
    knots = np.geomspace(low, high, KNOTS + 1)[1:]
    lines = np.maximum(knots - (features @ weights)[:, None], 0)
    lines = np.concatenate([lines, np.ones((len(lines), 1))], axis=1)
    *heights, floor = _non_negative(lines * np.sqrt(variances)[:, None], normalized)
    return weights, knots, np.array(heights), floor


def _non_negative(rows: np.ndarray, results: np.ndarray) -> np.ndarray:
    """Return the x (F,), at least 0, for which rows (n, F) @ x is nearest to results (n,)."""
    # `nnls` gets the triangular factor, which is several times as fast for hundreds of features.
    factor = np.asarray(np.linalg.qr(np.column_stack([rows, results]), mode="r"))
    solution, _ = nnls(factor[:, :-1], factor[:, -1])
    return np.asarray(solution)
