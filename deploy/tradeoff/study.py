"""What one run of `tradeoff` found: what its report, its table and its advice are made from."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from profiles.figures import Row


@dataclass(frozen=True)
class Front:
    """The points that none dominates in two figures.

    Attributes:
        x: key of the figure that is paid, "board latency".
        y: key of the figure that is bought, "PSNR".
        members: names of the points on the front by their values, along x from cheap to dear.
        steps: those of them that are better and dearer than the one before beyond the intervals.
        dominated: name of a point to the name of one that dominates it beyond the intervals.
        prices: a sentence on what each step costs.
    """

    x: str
    y: str
    members: tuple[str, ...]
    steps: tuple[str, ...]
    dominated: Mapping[str, str]
    prices: tuple[str, ...]


@dataclass(frozen=True)
class Crop:
    """The same place of one image as a point restores it; also the degraded input and the reference.

    Attributes:
        point: name of the point, "degraded" or "reference".
        title: what to write above it.
        dn: (h, w) float32 digital numbers.
        psnr_db: of this crop against the reference's; None for the reference.
    """

    point: str
    title: str
    dn: np.ndarray
    psnr_db: float | None


@dataclass(frozen=True)
class Study:
    """All that one run of `tradeoff` found.

    Attributes:
        headline: one sentence for a project manager.
        points: a row of the table "points" each.
        fronts: one for each pair of axes.
        advice: sentences: the best point for the budget or the need, and what it would take to do better.
        crops: pictures of chosen points.
        layers: time of each layer on the board, by network.
        placement: what runs where, by network.
        notes: limits, and how to read it.
        boards: the networks on every configuration of the boards asked for, a row of the table "boards" each.
    """

    headline: str
    points: tuple[Row, ...]
    fronts: tuple[Front, ...]
    advice: tuple[str, ...]
    crops: tuple[Crop, ...]
    layers: Mapping[str, tuple[Row, ...]]
    placement: Mapping[str, tuple[Row, ...]]
    notes: tuple[str, ...]
    boards: tuple[Row, ...] = ()
