"""What is known not to hold, by name: where, how far at most, and what it means to a user."""

from dataclasses import dataclass

from deploy.stress.checks import Measure


@dataclass(frozen=True)
class Limitation:
    """One thing that does not hold; beyond its ceiling it is a failure like any other.

    Attributes:
        name: as in the tables.
        stages: where it is known.
        checks: what does not hold.
        cases: of which hard cases; none for all.
        ceiling: the largest value of such a check that it explains.
        meaning: to a user, in a sentence.
    """

    name: str
    stages: tuple[str, ...]
    checks: tuple[str, ...]
    cases: tuple[str, ...]
    ceiling: float
    meaning: str


NETWORKS = ("float32", "INT8")

LIMITATIONS: tuple[Limitation, ...] = (
    Limitation(
        "narrow images",
        NETWORKS,
        ("ringing", "mean moved", "border"),
        ("1 x 1", "1 x N", "flat 1 x N"),
        1000,
        "Of an image narrower than the receptive radius every pixel has padding in reach: brightness is not kept.",
    ),
    Limitation(
        "border",
        NETWORKS,
        ("border",),
        (),
        500,
        "At the image's border zero padding looks like a black edge to the network; within its receptive radius "
        "bright flat ground is off, in INT8 more, which clips the correction that float makes there.",
    ),
    Limitation(
        "clipped corrections",
        ("INT8",),
        ("mean error against float",),
        (),
        410,
        "int8 holds corrections of about half of full scale at most; where float makes larger ones, on full contrast "
        "between single pixels, INT8 sharpens less.",
    ),
    Limitation(
        "isolated pixels",
        NETWORKS,
        ("ringing",),
        ("snow", "glint", "hot pixel", "SNR 3"),
        200,
        "A single pixel unlike all around it is taken for a blurred point and driven beyond its value, to black or "
        "full scale at most.",
    ),
    Limitation(
        "groups of patches",
        ("traditional",),
        ("gain", "error against float64"),
        (),
        200,
        "NL-Bayes takes or leaves a patch by its distance; a change in the last bit can tip that, and then a pixel "
        "moves by what the other group says.",
    ),
)


def limitation_of(stage: str, case: str, measure: Measure) -> Limitation | None:
    """The limitation that explains a measure which does not hold, or None."""
    for limit in LIMITATIONS:
        known = stage in limit.stages and measure.check in limit.checks and (not limit.cases or case in limit.cases)
        if known and measure.value <= limit.ceiling:
            return limit
    return None
