"""The same place of one image as the points restore it: what the eye is to judge."""

from collections.abc import Sequence

import numpy as np

from deploy.evaluation.pairs import NamedPair
from deploy.evaluation.scores import fidelity_db
from deploy.report.pictures import busiest_windows
from deploy.restore import MAX_DN, restore_with
from deploy.tradeoff.lab import Lab
from deploy.tradeoff.outcome import Outcome
from deploy.tradeoff.points import Unit
from deploy.tradeoff.study import Crop, Front

CROP_PX, MOST = 128, 8
FRONT = ("board latency", "PSNR")


def crop_points(
    outcomes: Sequence[Outcome], fronts: Sequence[Front], chosen: Sequence[Outcome | None]
) -> list[Outcome]:
    """Chosen points, the best of each kind, and those on the front of PSNR against latency: one a unit and halo."""
    by_name = {each.name: each for each in outcomes}
    members = [by_name[name] for front in fronts if (front.x, front.y) == FRONT for name in front.members]
    known = sorted((o for o in outcomes if o.value("PSNR") is not None), key=lambda o: -(o.value("PSNR") or 0.0))
    best = {each.point.unit.kind: each for each in reversed(known)}.values()
    wanted = [each for each in (*chosen, *best, *reversed(members)) if each is not None]
    alike: dict[tuple[Unit, str], Outcome] = {}
    for each in wanted:
        alike.setdefault((each.point.unit, each.point.halo), each)
    return list(alike.values())[:MOST]


def make_crops(points: Sequence[Outcome], lab: Lab) -> tuple[Crop, ...]:
    """Degraded, each point as it would restore it, reference; of the pair that is hardest to restore."""
    max_dn = lab.ground.instruments.max_dn
    pair = hardest(lab.ground.pairs, max_dn)
    side = min(CROP_PX, *pair.reference.shape)
    top, left = busiest_windows(pair.reference, side)[0]

    def crop(name: str, title: str, dn: np.ndarray) -> Crop:
        here, truth, seen = (
            np.asarray(image[top : top + side, left : left + side], np.float32)
            for image in (dn, pair.reference, pair.degraded)
        )
        return Crop(name, title, here, None if dn is pair.reference else fidelity_db(here, truth, seen, max_dn))

    made = [crop(each.name, each.name, _restored(each, pair, lab)) for each in points]
    return (crop("degraded", "degraded", pair.degraded), *made, crop("reference", "reference", pair.reference))


def hardest(pairs: Sequence[NamedPair], max_dn: int = MAX_DN) -> NamedPair:
    """The pair whose degraded image is farthest from its reference, among those that hold a crop where any does."""
    large = [pair for pair in pairs if min(pair.reference.shape) >= CROP_PX] or pairs
    return min(large, key=lambda pair: fidelity_db(pair.degraded, pair.reference, pair.degraded, max_dn))


def _restored(outcome: Outcome, pair: NamedPair, lab: Lab) -> np.ndarray:
    opened, point = lab.shelf.open(outcome.point.unit), outcome.point
    if opened.infer is None:
        return opened.restore(pair.degraded)
    halo_px = point.halo_px(lab.shelf.radius_px(point.unit.method))
    return restore_with(opened.infer, pair.degraded, point.tile_px, halo_px, max_dn=lab.shelf.max_dn)
