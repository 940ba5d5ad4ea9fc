import sys
import time
from functools import partial
from pathlib import Path

import psutil
import pytest

from beers_deploy.performance import timing
from beers_deploy.performance.timing import interleaved, load_of_others, timed
from beers_deploy.profiles.figures import measured

counters = pytest.mark.skipif(
    sys.platform == "win32", reason="Linux's counters have names that Windows refuses"
)


def counter(root: Path, energy_uj: int, name: str = "package-0") -> Path:
    domain = root / "intel-rapl:0"
    domain.mkdir(parents=True)
    (domain / "name").write_text(f"{name}\n")
    (domain / "energy_uj").write_text(f"{energy_uj}\n")
    (domain / "max_energy_range_uj").write_text("1000000\n")
    return domain / "energy_uj"


# The counter starts again at max_energy_range_uj, so 100,000 uJ after 900,000 uJ are 0.2 J.
@counters
@pytest.mark.parametrize(
    ("before", "after", "joules"), [(200_000, 700_000, 0.5), (900_000, 100_000, 0.2)]
)
def test_power_is_energy_over_time_also_of_a_counter_that_starts_again(
    before: int, after: int, joules: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "POWERCAP", tmp_path)
    energy = counter(tmp_path, before)
    _, elapsed_s, power = timed(lambda: energy.write_text(str(after)))
    assert power.mode == "measured"
    assert power.value == pytest.approx(joules / elapsed_s)


@counters
@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [("", "", "no RAPL"), ("dram", "5", "no RAPL"), ("package-0", "?", "cannot be read")],
)
def test_without_counters_of_the_package_power_is_unavailable_with_a_reason(
    name: str, text: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "POWERCAP", tmp_path)
    if name:
        counter(tmp_path, 5, name).write_text(text)
    result, elapsed_s, power = timed(lambda: 7)
    assert (result, power.mode, power.value) == (7, "unavailable", None)
    assert elapsed_s > 0
    assert reason in power.reason


@pytest.mark.parametrize(("rounds", "least_s"), [(3, 0.0), (2, 0.02)])
def test_calls_run_round_by_round_until_there_are_enough_and_they_took_long_enough(
    rounds: int, least_s: float
) -> None:
    calls: list[str] = []

    def call(name: str) -> None:
        calls.append(name)
        time.sleep(0.002)

    series = interleaved([partial(call, name) for name in ("a", "b")], rounds, least_s)
    count = len(series[0])
    assert calls == ["a", "b"] * count
    assert [len(timings) for timings in series] == [count, count]
    assert count == rounds if least_s == 0 else count > rounds
    for times in ([time_s for time_s, _ in timings] for timings in series):
        assert sum(times) >= least_s
    if least_s:
        assert min(sum(time_s for time_s, _ in timings[:-1]) for timings in series) < least_s


@pytest.mark.parametrize(
    ("percent", "own_cpus", "others"), [(100, 0.5, 0.5), (50, 0.5, 0), (3, 1, 0)]
)
def test_the_load_of_others_is_what_this_process_did_not_take(
    percent: float, own_cpus: float, others: float
) -> None:
    own_s = own_cpus * (psutil.cpu_count() or 1) * 2.0
    load = measured(percent, "%", "a test")
    assert load_of_others(load, own_s, 2.0) == pytest.approx(others)
