import math
from functools import lru_cache

import numpy as np
import pytest

from beers_deploy.model.metrics.edge_blur import THOROUGH, AxisMtf, blurs_of, combine, plain_squares
from beers_deploy.model.metrics.edge_fit import HALF_PX, STRICT, EdgeBlur, fit_blurs
from beers_deploy.model.metrics.instrument import axis_mtfs
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.simulator.mtf import Blur, gamma_from_mtf
from beers_deploy.model.simulator.procedural import procedural_scene
from tests.model.simulator import stages

RATIO = 4
SIDE_PX = 120
SIGMA = 6.0


def noise(values: np.ndarray) -> np.ndarray:
    return np.full(values.shape, SIGMA**2)


def find_blurs(image: np.ndarray, clipped_at: float = 4095) -> list[EdgeBlur]:
    return blurs_of(plain_squares(image, noise, clipped_at, THOROUGH), noise)


def blurred(scene: np.ndarray, mtf_nyquist: Blur, smear_px: float = 0.0) -> np.ndarray:
    return stages.blurred(scene, RATIO, mtf_nyquist, smear_px=smear_px) * 10.0


@lru_cache
def clean(mtf_nyquist: float, angle_deg: float) -> np.ndarray:
    """Return an edge through the middle, in digital numbers."""
    return blurred(slanted_edge(SIDE_PX, RATIO, angle_deg, (40.0, 160.0)), mtf_nyquist)


def square(image: np.ndarray, angle_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Return 17 x 17 pixels around a random place on the edge, with new noise."""
    middle = (SIDE_PX - 1) / 2
    row = int(rng.integers(45, 75))
    column = round(middle - (row - middle) * math.tan(math.radians(angle_deg)))
    part = image[row - HALF_PX : row + HALF_PX + 1, column - HALF_PX : column + HALF_PX + 1]
    return np.asarray(part + SIGMA * rng.standard_normal(part.shape))


def edges(mtf_nyquist: float, angle_deg: float, count: int, seed: int = 0) -> list[EdgeBlur]:
    rng = np.random.default_rng(seed)
    squares = [square(clean(mtf_nyquist, angle_deg), angle_deg, rng) for _ in range(count)]
    return blurs_of(np.stack(squares), noise)


@pytest.mark.parametrize("mtf_nyquist", [0.02, 0.05, 0.12])
@pytest.mark.parametrize("angle_deg", [0.0, 4.0, 15.0, 30.0])
def test_one_small_square_gives_the_blur(mtf_nyquist: float, angle_deg: float) -> None:
    blurs = edges(mtf_nyquist, angle_deg, 30)
    assert len(blurs) >= 25
    off = np.array([edge.gamma for edge in blurs]) - gamma_from_mtf(mtf_nyquist)
    assert abs(off.mean()) < 0.07
    assert off.std() == pytest.approx(np.mean([edge.error for edge in blurs]), rel=0.5)


@pytest.mark.parametrize("mtf_nyquist", [0.03, 0.1])
def test_the_interval_of_a_few_edges_holds_the_truth(mtf_nyquist: float) -> None:
    estimates = [combine(edges(mtf_nyquist, 6.0, 4, seed), []) for seed in range(20)]
    assert sum(axis.interval[0] <= mtf_nyquist <= axis.interval[1] for axis in estimates) >= 18
    assert np.median([axis.mtf_nyquist for axis in estimates]) == pytest.approx(
        mtf_nyquist, rel=0.05
    )
    assert all(axis.interval[1] < 1.5 * axis.interval[0] for axis in estimates)


@pytest.mark.parametrize(("count", "is_enough"), [(2, False), (3, True)])
def test_three_edges_are_enough_for_an_axis(count: int, is_enough: bool) -> None:
    rng = np.random.default_rng(3)
    # So few pixels hold one square.
    edge = clean(0.1, 5.0)[49:70, 49:70]
    windows = [edge + SIGMA * rng.standard_normal(edge.shape) for _ in range(count)]
    assert sum(len(find_blurs(window)) for window in windows) == count
    measured = axis_mtfs(windows, noise, 4095)
    assert isinstance(measured["across"], AxisMtf) is is_enough
    assert isinstance(measured["along"], Refusal)


def board(mtf_nyquist: Blur, lean_deg: float = 8.0, smear_px: float = 0.0) -> np.ndarray:
    upright = slanted_edge(SIDE_PX, RATIO, lean_deg, (-1.0, 1.0))
    image = blurred(
        100 + 60 * upright * slanted_edge(SIDE_PX, RATIO, -lean_deg, (-1.0, 1.0)).T,
        mtf_nyquist,
        smear_px,
    )
    return np.asarray(image + SIGMA * np.random.default_rng(1).standard_normal(image.shape))


@pytest.mark.parametrize("lean_deg", [8.0, 25.0])
def test_a_board_shows_both_axes(lean_deg: float) -> None:
    image = board((0.12, 0.05), lean_deg)[10:-10, 10:-10]
    upright = find_blurs(image)
    lying = find_blurs(image.T)
    assert min(len(upright), len(lying)) >= 3
    assert combine(upright, lying).mtf_nyquist == pytest.approx(0.12, rel=0.08)
    assert combine(lying, upright).mtf_nyquist == pytest.approx(0.05, rel=0.08)


def test_a_curve_that_falls_more_steeply_is_no_higher_at_nyquist() -> None:
    """One pixel of smear keeps 0.64 at Nyquist and more below it, so a curve of the profile's
    formula would be too high at Nyquist.
    """
    image = board(0.1, smear_px=1.0)[10:-10, 10:-10]
    smeared = combine(find_blurs(image.T), find_blurs(image))
    true = 0.1 * float(np.sinc(0.5))
    assert smeared.interval[0] <= true <= smeared.interval[1]
    assert smeared.mtf_nyquist == pytest.approx(true, rel=0.1)
    assert smeared.nearest > 1.2 * true


def test_clipped_edges_are_ignored() -> None:
    image = board(0.07)[10:-10, 10:-10]
    assert find_blurs(image)
    assert not find_blurs(image, 1500)
    assert not find_blurs(image - 500)


def test_a_landscape_has_no_such_edge() -> None:
    """Textured roads, roofs and crop rows have hundreds of steep places, but no plain step."""
    scene = procedural_scene(1200, 1200, np.random.default_rng(3)).radiance.copy()
    # Cover the scene's calibration site, which has plain steps, with landscape.
    scene[:400] = scene[400:800]
    image = blurred(scene, 0.07)
    image = image + SIGMA * np.random.default_rng(2).standard_normal(image.shape)
    assert len(find_blurs(image)) + len(find_blurs(image.T)) == 0


def is_edge(region: np.ndarray) -> bool:
    region = region + SIGMA * np.random.default_rng(4).standard_normal(region.shape)
    return fit_blurs(region[None], noise, STRICT) != [None]


def test_regions_other_than_a_blurred_step_are_refused() -> None:
    edge = clean(0.07, 6.0)[40:80, 40:80]
    sharpened = edge.copy()
    sharpened[:, 2:-2] += 1.5 * (2 * edge[:, 2:-2] - edge[:, :-4] - edge[:, 4:])
    column = np.arange(40) - 19.5
    flat = np.ones((40, 1))
    others = {
        "a road": flat * (900 + 600 * np.exp(-((column / 2) ** 2))),
        "a slope": flat * np.clip(1000 + 60 * column, 400, 1600),
        "a faint step": flat * np.where(column < 0, 1000.0, 1020.0),
        "nothing": np.full((40, 40), 1000.0),
        "sharpened": sharpened,
    }
    for name, region in others.items():
        assert not is_edge(region), name
    assert is_edge(edge)
    assert not is_edge(edge[:2])
