"""What a reader has to know: limits, and how to read the points."""

import math
from collections.abc import Mapping, Sequence

from deploy.tradeoff.accuracy import Ground
from deploy.tradeoff.board import PAIR_QUANTILE, pair_error
from deploy.tradeoff.host_time import ROUNDS
from deploy.tradeoff.host_time import TILE_PX as HOST_TILE_PX
from deploy.tradeoff.int8 import PATCH_PX, PATCHES
from model.metrics.bootstrap import LEAST_SITES


def notes(
    ground: Ground, sampled: str, small: Sequence[str], lacks: Mapping[str, str], calibrated_on: str
) -> tuple[str, ...]:
    """Sentences, the most important first; `sampled` says at what oversampling, where that is not the profile's."""
    spread = f"{math.exp(pair_error()):.2f} times either way ({PAIR_QUANTILE:.0%} of published pairs)"
    found = [
        "No board was used: figures of the board are predicted, its power is an assumption that no network changes.",
        f"Pictures are judged on {len(ground.pairs)} whole images of {len(set(ground.sites))} sites.",
        "The paper's shape is judged with the weights of that shape at hand, not with the paper's own.",
        "Points are told apart by the differences on the same images: their own intervals show how images differ.",
        f"Times on the board are told apart by their ratio, with none and all of the memory's hidden, and {spread}.",
        "Points of one network, tile and configuration are told apart on the board by their count of tiles alone.",
        "Energies of two networks or configurations may also differ by the whole range assumed for the power.",
        "With the exact halo the picture does not depend on the tile.",
        "With less, seams were measured on images cut in four and weighed by the swath's seams: predicted.",
        f"Host times, {ROUNDS} rounds of a tile of {HOST_TILE_PX} px in turns, are no proxy for the board.",
        f"INT8 files made here: {PATCHES} patches of {PATCH_PX} x {PATCH_PX} from {calibrated_on}.",
        "Chains and peers are told both sensors; what a network was told stands beside it.",
        "A chain on the board's CPU is scaled from CPU time here by benchmarks of other programs: a wide interval.",
    ]
    sites = len(set(ground.sites))
    if sites < LEAST_SITES:
        found.append(
            f"No interval over sites is shown, and pictures tell no two points apart: of {sites}, fewer than "
            f"{LEAST_SITES}, none could be trusted."
        )
    found += [f"{sampled[0].upper()}{sampled[1:]}."] if sampled else []
    found += [f"Left out, too small: {', '.join(small)}."] if small else []
    return (*found, *(f"{unit} is not there: {reason}." for unit, reason in lacks.items()))
