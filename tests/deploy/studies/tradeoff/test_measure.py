"""What is kept of measurements, and times on this machine."""

import json
from functools import partial
from pathlib import Path

import numpy as np

from beers_deploy.studies.tradeoff.measure import ROUNDS, Measurements, host_figures, host_times, key_of


def test_what_was_measured_is_kept_by_what_it_depends_on(tmp_path: Path) -> None:
    path, calls = tmp_path / "measurements.json", list[int]()

    def measure() -> list[int]:
        calls.append(1)
        return [len(calls)]

    kept = Measurements.open(path)
    assert kept.make(key_of(model="a"), measure) == [1]
    assert Measurements.open(path).make(key_of(model="a"), measure) == [1]
    assert Measurements.open(path).make(key_of(model="b"), measure) == [2]
    assert len(json.loads(path.read_text())["measurements"]) == 2


def test_methods_are_timed_in_turns_after_a_run_for_warm_up() -> None:
    order = list[str]()

    def restore(name: str, dn: np.ndarray) -> np.ndarray:
        order.append(name)
        return dn

    names = ("one", "other")
    found = host_times([partial(restore, name) for name in names], np.zeros((4, 4)))
    assert [len(times) for times in found] == [ROUNDS, ROUNDS]
    assert order == [*names] * (ROUNDS + 1)


def test_host_figures_are_percentiles_for_a_megapixel() -> None:
    figures = host_figures([0.1, 0.2, 0.3], 100_000)
    assert figures["host p50"].value == 2.0
    assert (figures["host p90"].value or 0.0) > 2.0
    assert {figure.mode for figure in figures.values()} == {"measured"}
