"""Pairs a second of 128 x 128 patches at r = 5, with a margin of 32: ours against two plain ways, in one run.

    python benchmarks/simulator.py --seconds 6

(a) the same effects, each by itself at full resolution, then sampling; (b) all effects at full resolution, whatever
the scene calls for. The plain ways keep their transfer functions from one pair to the next, as ours does.

Ratios are what counts: machines differ and are shared. Ways are interleaved, so that what else the machine does falls
on all of them alike; the figures are medians over the turns.
"""

import argparse
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import replace
from functools import lru_cache
from statistics import median

import numpy as np
from scipy import fft

from beers_deploy.model.simulator.acquire import prepare_scene, simulate_planned
from beers_deploy.model.simulator.detector import (
    DN_EFFECTS,
    RADIANCE_EFFECTS,
    Draw,
    add_noise,
    apply_effect,
    digitise,
)
from beers_deploy.model.simulator.mtf import gaussian_response, mtf, smear_response
from beers_deploy.model.simulator.plan import make_plan
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.effects import AntiAlias, Effect, Smear, middle_effect
from beers_deploy.profiles.scene_call import typical_effects
from beers_deploy.profiles.sensor import Instrument

RATIO, PATCH_PX, MARGIN_PX, PROCESSES, TURNS = 5, 128, 32, 2, 5
ROLES = ("degraded", "reference")
ALL: dict[str, Effect] = {name: middle_effect(name, table) for name, table in typical_effects().items()}


def sensors(effects: dict[str, Effect]) -> tuple[Instrument, Instrument]:
    """The degraded and the reference sensor with these effects."""
    degraded, reference = (load_sensor(f"pleiades-{role}").nominal() for role in ROLES)
    return replace(degraded, effects=effects), replace(reference, effects=effects)


def ours(radiance: np.ndarray, eyes: tuple[Instrument, Instrument], number: int) -> None:
    """One transform of the scene, then for each sensor a plan and one fused pass."""
    scene = prepare_scene(radiance, RATIO)
    for sensor, role in zip(eyes, ROLES, strict=True):
        simulate_planned(scene, sensor, Draw(0, number), make_plan(sensor, scene.stats), role, MARGIN_PX)


def one_by_one(radiance: np.ndarray, eyes: tuple[Instrument, Instrument], number: int) -> None:
    """Every effect of each sensor in turn."""
    for sensor, role in zip(eyes, ROLES, strict=True):
        _acquire_plainly(radiance, sensor, number, role)


def _acquire_plainly(radiance: np.ndarray, sensor: Instrument, number: int, role: str) -> np.ndarray:
    """Each effect by itself at full resolution, random ones included where they act on the scene's grid."""
    height, width = radiance.shape
    antialias, smear = sensor.effects.get("antialias"), sensor.effects.get("smear")
    sigma_px = antialias.sigma_px if isinstance(antialias, AntiAlias) else 0.0
    length_px = smear.length_px if isinstance(smear, Smear) else 0.0
    for response in _responses(height, width, sensor.mtf_nyquist, sigma_px, length_px):
        radiance = fft.irfft2(fft.rfft2(radiance) * response, s=(height, width))
    draw = Draw(0, number)
    for name in RADIANCE_EFFECTS:
        radiance = _apply(radiance, name, sensor, draw, role)
    image = add_noise(radiance, sensor, draw.generator(f"noise-{role}")) * sensor.gain_dn_per_radiance
    for name in DN_EFFECTS:
        image = _apply(image, name, sensor, draw, role)
    sampled = image[RATIO // 2 :: RATIO, RATIO // 2 :: RATIO]
    return digitise(sampled[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX], sensor)


@lru_cache
def _responses(height: int, width: int, mtf_nyquist: float, sigma_px: float, length_px: float) -> list[np.ndarray]:
    """One transfer function for each blur that is not neutral."""
    fy, fx = np.fft.fftfreq(height, 1 / RATIO)[:, None], np.fft.rfftfreq(width, 1 / RATIO)[None]
    responses = [mtf(fx, fy, mtf_nyquist)]
    if sigma_px:
        responses.append(gaussian_response(np.hypot(fx, fy), sigma_px))
    if length_px:
        responses.append(smear_response(fy, length_px))
    return [response.astype(np.float32) for response in responses]


def _apply(image: np.ndarray, name: str, sensor: Instrument, draw: Draw, role: str) -> np.ndarray:
    if name not in sensor.effects:
        return image
    return apply_effect(image, sensor.effects[name], sensor, lambda: draw.generator(f"{name}-{role}"))


WAYS: dict[str, tuple[Callable[[np.ndarray, tuple[Instrument, Instrument], int], None], bool, bool]] = {
    # name: (way, all effects called for, all effects made)
    "two effects: ours": (ours, False, False),
    "two effects: (a) one by one": (one_by_one, False, False),
    "two effects: (b) fixed chain of all": (one_by_one, False, True),
    "all effects: ours": (ours, True, True),
    "all effects: (a) one by one": (one_by_one, True, True),
}


def rate(name: str, seconds: float, seed: int) -> float:
    """Pairs a second of one process."""
    way, _, made = WAYS[name]
    side = (PATCH_PX + 2 * MARGIN_PX) * RATIO
    radiance = procedural_scene(side, side, np.random.default_rng(seed)).radiance
    eyes = sensors(ALL if made else {})
    way(radiance, eyes, 0)  # warm-up: transfer functions are cached, as in a run
    started, done = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        done += 1
        way(radiance, eyes, done)
    return done / (time.perf_counter() - started)


def main() -> None:
    """Measure every way on two processes and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=6.0, help="time for each way")
    seconds = parser.parse_args().seconds
    turns: dict[str, list[float]] = {name: [] for name in WAYS}
    with ProcessPoolExecutor(PROCESSES, mp_context=multiprocessing.get_context("spawn")) as pool:
        wait([pool.submit(rate, name, 0.2, 0) for name in WAYS for _ in range(PROCESSES)])  # imports, caches
        for _ in range(TURNS):
            for name, rates in turns.items():
                jobs = [pool.submit(rate, name, seconds / TURNS, seed) for seed in range(PROCESSES)]
                rates.append(sum(job.result() for job in jobs))
    for name, rates in turns.items():
        best = turns[name.split(":")[0] + ": ours"]
        times = median(ours / plain for ours, plain in zip(best, rates, strict=True))
        print(
            f"{name:40s} {median(rates):7.1f} pairs/s ({min(rates):.0f} to {max(rates):.0f}) "
            f"on {PROCESSES} processes   ours is {times:4.1f} times as fast"
        )


if __name__ == "__main__":
    main()
