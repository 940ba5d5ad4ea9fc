"""How good the pictures of a unit are: every unit on the same held-out pairs and targets, image by image.

Kept image by image, because two points are told apart by the differences on the same images, which scatter far less
than the images do.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from deploy.evaluation.methods import Method, Restore
from deploy.evaluation.pairs import NamedPair
from deploy.evaluation.scores import Instruments
from deploy.evaluation.targets import Targets, snr_name, target_figures
from deploy.results import Figure
from deploy.tradeoff.cache import code_digest, pixels_digest

CODE = (
    "deploy.tradeoff.accuracy",
    "deploy.tradeoff.seams",
    "deploy.evaluation",
    "model.metrics",
    "deploy.restore",
    "deploy.tiling",
)
MAE = "float-INT8 MAE"
FLAT = "flat SNR"

Values = Mapping[str, float | None]
"""Scores of one image by name; None where the instrument is not there."""


@dataclass(frozen=True)
class Scores:
    """Scores of a unit: of each pair, in their order, and on targets."""

    images: tuple[Values, ...]
    targets: Mapping[str, Figure] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        targets = {key: vars(figure) for key, figure in self.targets.items()}
        return {"images": [dict(values) for values in self.images], "targets": targets}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """The inverse."""
        targets = {
            k: Figure(**{**f, "interval": tuple(f["interval"] or ()) or None}) for k, f in stored["targets"].items()
        }
        return cls(tuple(dict(values) for values in stored["images"]), targets)


@dataclass(frozen=True)
class Ground:
    """What all units are judged on.

    Attributes:
        pairs: held-out pairs.
        targets: edges and flat fields acquired by the same sensor.
        instruments: what is measured.
        weights: digest of the weights that an instrument brings.
        seed: of the bootstrap.
    """

    pairs: Sequence[NamedPair]
    targets: Targets
    instruments: Instruments
    weights: str
    seed: int

    @cached_property
    def key(self) -> dict[str, object]:
        """Everything that scores depend on besides the unit."""
        pairs = pixels_digest(image for pair in self.pairs for image in (pair.degraded, pair.reference))
        names = [pair.name for pair in self.pairs]
        targets = pixels_digest([*self.targets.edges, *(flat for _, flat in self.targets.flats)])
        given = {"pairs": pairs, "names": names, "targets": targets, "weights": self.weights}
        return {**given, "max_dn": self.instruments.max_dn, "code": code_digest(*CODE)}

    @property
    def sites(self) -> list[str]:
        """The site of each pair."""
        return [pair.site for pair in self.pairs]


def measure(restore: Restore, ground: Ground, tick: Callable[[], None]) -> Scores:
    """Scores on every pair and on the targets; `tick` is called once a pair and once for the targets."""
    images = measure_images(restore, ground, tick)
    found = target_figures(Method("", restore, ""), ground.targets)
    tick()
    dark = snr_name(ground.targets.flats[0][0])
    return Scores(images, {"MTF at Nyquist": found["MTF at Nyquist"], FLAT: found[dark]})


def measure_images(restore: Restore, ground: Ground, tick: Callable[[], None]) -> tuple[Values, ...]:
    """Scores on every pair."""
    images = []
    for pair in ground.pairs:
        values = ground.instruments.score(restore(pair.degraded), pair.reference, pair.degraded)
        images.append({key: value for key, value in values.items() if key != "PSNR gain"})
        tick()
    return tuple(images)


def measure_mae(restore: Restore, float_restore: Restore, ground: Ground, tick: Callable[[], None]) -> Scores:
    """Mean difference of INT8 from float on every pair, of full scale; both in whole digital numbers, as in files."""
    images = []
    for pair in ground.pairs:
        in_int8, in_float = (np.asarray(each(pair.degraded), np.float64) for each in (restore, float_restore))
        images.append({MAE: float(np.abs(in_int8 - in_float).mean()) / ground.instruments.max_dn})
        tick()
    return Scores(tuple(images))
