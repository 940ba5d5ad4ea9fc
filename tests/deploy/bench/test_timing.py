import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from beers_deploy.bench.timing import interleaved, timed

counters = pytest.mark.skipif(sys.platform == "win32", reason="Linux's counters have names that Windows refuses")


def counter(root: Path, energy_uj: int, name: str = "package-0") -> Path:
    domain = root / "intel-rapl:0"
    domain.mkdir(parents=True)
    (domain / "name").write_text(f"{name}\n")
    (domain / "energy_uj").write_text(f"{energy_uj}\n")
    (domain / "max_energy_range_uj").write_text("1000000\n")
    return domain / "energy_uj"


@counters
def test_power_is_energy_over_time(tmp_path: Path) -> None:
    energy = counter(tmp_path, 200_000)
    _, elapsed_s, power = timed(lambda: energy.write_text("700000"), tmp_path)
    assert power.mode == "measured"
    assert power.value == pytest.approx(0.5 / elapsed_s)


@counters
def test_a_counter_that_starts_again_goes_on(tmp_path: Path) -> None:
    energy = counter(tmp_path, 900_000)
    _, elapsed_s, power = timed(lambda: energy.write_text("100000"), tmp_path)
    assert power.value == pytest.approx(0.2 / elapsed_s)


@counters
def test_without_counters_power_is_unavailable_with_a_reason(tmp_path: Path) -> None:
    result, elapsed_s, power = timed(lambda: 7, tmp_path)
    assert (result, power.mode, power.value) == (7, "unavailable", None)
    assert elapsed_s > 0
    assert "no RAPL" in power.reason


@counters
def test_counters_of_other_domains_are_not_the_package(tmp_path: Path) -> None:
    counter(tmp_path, 5, name="dram")
    assert timed(lambda: None, tmp_path)[2].mode == "unavailable"


@counters
def test_a_counter_that_holds_no_number_is_unavailable(tmp_path: Path) -> None:
    counter(tmp_path, 5).write_text("?")
    assert "cannot be read" in timed(lambda: None, tmp_path)[2].reason


def test_calls_run_round_by_round_until_there_are_enough() -> None:
    ran: list[str] = []

    def call(name: str) -> Callable[[], str]:
        def run() -> str:
            ran.append(name)
            return name

        return run

    asked: list[list[int]] = []

    def enough(found: Sequence[Sequence[object]]) -> bool:
        asked.append([len(taken) for taken in found])
        return len(found[0]) == 3

    found = interleaved([call("a"), call("b")], lambda work: f"{work()}{len(ran)}", enough)
    assert ran == ["a", "b"] * 3
    assert found == [["a1", "a3", "a5"], ["b2", "b4", "b6"]]
    assert asked == [[1, 1], [2, 2], [3, 3]]
