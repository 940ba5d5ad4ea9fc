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
@pytest.mark.parametrize(("before", "after", "joules"), [(200_000, 700_000, 0.5), (900_000, 100_000, 0.2)])
def test_power_is_energy_over_time_also_of_a_counter_that_starts_again(
    before: int, after: int, joules: float, tmp_path: Path
) -> None:
    energy = counter(tmp_path, before)
    _, elapsed_s, power = timed(lambda: energy.write_text(str(after)), tmp_path)
    assert power.mode == "measured"
    assert power.value == pytest.approx(joules / elapsed_s)


@counters
@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [("", "", "no RAPL"), ("dram", "5", "no RAPL"), ("package-0", "?", "cannot be read")],
)
def test_without_counters_of_the_package_power_is_unavailable_with_a_reason(
    name: str, text: str, reason: str, tmp_path: Path
) -> None:
    if name:
        counter(tmp_path, 5, name).write_text(text)
    result, elapsed_s, power = timed(lambda: 7, tmp_path)
    assert (result, power.mode, power.value) == (7, "unavailable", None)
    assert elapsed_s > 0
    assert reason in power.reason


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
