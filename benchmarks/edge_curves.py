"""The MTF table that uneven edges give: errors, how often the interval holds the truth, how many
are refused.

    python benchmarks/edge_curves.py --images aerial-train/

An edge lies between two pieces of the folder's photographs, each with texture of 5 or 10 % of the
step, leans by 2 to 25 degrees, and is seen by sensors of different MTF curves with the noise of
`pleiades-degraded`.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from beers_deploy.model.curves import FREQUENCIES as TABULATED
from beers_deploy.model.curves import pupil_contrast
from beers_deploy.model.metrics.edge_curve import (
    FREQUENCIES,
    MtfCurve,
    measure_curve,
)
from beers_deploy.model.metrics.edge_search import Edge, edge_in
from beers_deploy.model.metrics.noise_blocks import ROUNDING
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.simulator.acquire import acquire
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.sampling import read_scene, scene_spectrum
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST, MtfTable
from beers_deploy.profiles.sensor import Sensor

LIKE = Sensor.load("pleiades-degraded").nominal()
OVERSAMPLING = 4
SIDE_PX = 112
MARGIN_PX = 24
DARK = 50.0
BRIGHT = 120.0
LEANS_DEG = (2.0, 25.0)
CONTRASTS = (0.04, 0.07, 0.12)
UNEVEN = (0.05, 0.1)
SETS = ((1, 40), (4, 24), (8, 20), (14, 17))
"""How many edges of how many pixels' length are measured together."""
SHOWN = (0.1, 0.25, NYQUIST)


class Outcome(NamedTuple):
    """Of one measurement: relative errors, whether the intervals held the truth, and whether it was
    refused.
    """

    errors: np.ndarray
    held: np.ndarray
    refused: bool


def main() -> None:
    """Print a row for each curve and each set of edges."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    generator = np.random.default_rng(arguments.seed)
    textures = Textures([pixels_of(path) for path in list_images(arguments.images)], generator)
    print(
        "| curve | edges | error at 0.1, 0.25, 0.5, root mean square | in the 90 % interval | "
        "refused |"
    )
    print("|---|---|---|---|---|")
    everything = list[Outcome]()
    for name in CURVES:
        for count, length_px in SETS:
            judged_runs = list(outcomes(name, count, length_px, arguments.repeats, textures))
            print(row(f"{name} | {count} of {length_px} px", judged_runs), flush=True)
            everything += judged_runs
    print(row("all | all", everything))


def row(title: str, runs: Sequence[Outcome]) -> str:
    """Return a row of the table."""
    errors = np.sqrt(np.mean([run.errors**2 for run in runs], axis=0))
    coverage = np.mean([run.held for run in runs], axis=0)
    refused = np.mean([run.refused for run in runs])
    errors_text = ", ".join(f"{error:.1%}" for error in errors)
    covered = ", ".join(f"{share:.0%}" for share in coverage)
    return f"| {title} | {errors_text} | {covered} | {refused:.0%} |"


def outcomes(
    name: str, count: int, length_px: int, repeats: int, textures: "Textures"
) -> Iterator[Outcome]:
    """Measure sets of edges of one kind of curve, for each contrast and unevenness."""
    for contrast in CONTRASTS:
        for uneven in UNEVEN:
            sensor = sensor_with(name, contrast, textures.generator)
            assert sensor.response is not None  # noqa: S101 - it was made with one
            truth = np.asarray(sensor.response.at(np.array([SHOWN]), np.zeros((1, 1)))[0])
            for _ in range(repeats):
                edges = [textures.edge(sensor, uneven, length_px) for _ in range(count)]
                curve = measure_curve(
                    [e for e in edges if not isinstance(e, Refusal)], np.random.default_rng(0)
                )
                if isinstance(curve, MtfCurve):
                    yield judged(curve, truth)


def judged(curve: MtfCurve, truth: np.ndarray) -> Outcome:
    """Hold a curve against the true contrasts at SHOWN."""
    places = [int(np.argmin(np.abs(FREQUENCIES - frequency))) for frequency in SHOWN]
    covered = (curve.low[places] <= truth) & (truth <= curve.high[places])
    return Outcome(curve.contrast[places] / truth - 1, covered, curve.missing_edges > 0)


def pixels_of(path: Path) -> np.ndarray:
    """Return a photograph's radiance (H, W), mirrored at its ends where it is too small."""
    radiance = np.squeeze(read_scene(path, LIKE).radiance).astype(np.float64)
    padding = [(0, max(0, SIDE_PX * OVERSAMPLING + 1 - size)) for size in radiance.shape]
    return np.pad(radiance, padding, mode="reflect")


class Textures:
    """Pieces of photographs, and the edges that are drawn between them."""

    def __init__(self, photographs: Sequence[np.ndarray], generator: np.random.Generator) -> None:
        self.photographs = photographs
        self.generator = generator

    def piece(self) -> np.ndarray:
        """Return texture (S, S) of mean 0 and standard deviation 1."""
        photograph = self.photographs[int(self.generator.integers(len(self.photographs)))]
        side = SIDE_PX * OVERSAMPLING
        top, left = (int(self.generator.integers(size - side)) for size in photograph.shape)
        piece = photograph[top : top + side, left : left + side]
        return np.asarray(np.clip((piece - piece.mean()) / max(float(piece.std()), 1e-6), -3, 3))

    def edge(self, sensor: Instrument, uneven: float, length_px: int) -> Edge | Refusal:
        """Draw an edge, simulate the sensor's image of it and cut a box around it."""
        lean = float(self.generator.uniform(*LEANS_DEG))
        share = slanted_edge(SIDE_PX, OVERSAMPLING, lean, (0.0, 1.0))
        if self.generator.random() < 0.5:
            share = share[::-1]
        step = BRIGHT - DARK
        dark = DARK + uneven * step * self.piece()
        bright = BRIGHT + uneven * step * self.piece()
        scene = np.maximum(dark * (1 - share) + bright * share, 1.0).astype(np.float32)
        draw = Draw(int(self.generator.integers(1 << 30)))
        dn = acquire(
            scene_spectrum(scene),
            scene.shape[1],
            sensor,
            OVERSAMPLING,
            draw,
            "degraded",
            margin_px=MARGIN_PX,
        )
        pixels = to_uint16(dn).astype(np.float64)
        top = (pixels.shape[0] - length_px) // 2
        left = pixels.shape[1] // 2 - 10
        gain = sensor.gain_dn_per_radiance

        def noise(values: np.ndarray) -> np.ndarray:
            return np.asarray(sensor.alpha * gain * values + sensor.beta * gain**2 + ROUNDING)

        return edge_in(pixels[top : top + length_px, left : left + 20], noise, "drawn")


CURVES = ("formula", "Gaussian", "pupil", "sagging or bulging")


def sensor_with(name: str, contrast: float, generator: np.random.Generator) -> Instrument:
    """Return the sensor with another MTF curve of that contrast at Nyquist."""
    optics = contrast / np.sinc(NYQUIST)
    detector = np.sinc(TABULATED)
    if name == "sagging or bulging":
        hill = 0.25 * float(generator.choice([-1, 1])) * np.sin(np.pi * TABULATED / NYQUIST) ** 2
        values = np.minimum(optics ** (TABULATED / NYQUIST) * (1 + hill), 1.0) * detector
    elif name == "pupil":
        values = pupil_contrast(float(optics), 0.3) * detector
    elif name == "Gaussian":
        values = optics ** ((TABULATED / NYQUIST) ** 2) * detector
    else:
        values = optics ** (TABULATED / NYQUIST) * detector
    contrasts = tuple(values.tolist())
    table = MtfTable(tuple(TABULATED.tolist()), contrasts, contrasts)
    across, along = table.at_nyquist
    return replace(LIKE, response=table, mtf_nyquist=across, mtf_nyquist_along=along)


if __name__ == "__main__":
    main()
