import sys
from pathlib import Path

import pytest

from deploy.bench.timing import timed

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Linux's counters have names that Windows refuses")


def counter(root: Path, energy_uj: int, name: str = "package-0") -> Path:
    domain = root / "intel-rapl:0"
    domain.mkdir(parents=True)
    (domain / "name").write_text(f"{name}\n")
    (domain / "energy_uj").write_text(f"{energy_uj}\n")
    (domain / "max_energy_range_uj").write_text("1000000\n")
    return domain / "energy_uj"


def test_power_is_energy_over_time(tmp_path: Path) -> None:
    energy = counter(tmp_path, 200_000)
    _, elapsed_s, power = timed(lambda: energy.write_text("700000"), tmp_path)
    assert power.mode == "measured"
    assert power.value == pytest.approx(0.5 / elapsed_s)


def test_a_counter_that_starts_again_goes_on(tmp_path: Path) -> None:
    energy = counter(tmp_path, 900_000)
    _, elapsed_s, power = timed(lambda: energy.write_text("100000"), tmp_path)
    assert power.value == pytest.approx(0.2 / elapsed_s)


def test_without_counters_power_is_unavailable_with_a_reason(tmp_path: Path) -> None:
    result, elapsed_s, power = timed(lambda: 7, tmp_path)
    assert (result, power.mode, power.value) == (7, "unavailable", None)
    assert elapsed_s > 0
    assert "no RAPL" in power.reason


def test_counters_of_other_domains_are_not_the_package(tmp_path: Path) -> None:
    counter(tmp_path, 5, name="dram")
    assert timed(lambda: None, tmp_path)[2].mode == "unavailable"


def test_a_counter_that_holds_no_number_is_unavailable(tmp_path: Path) -> None:
    counter(tmp_path, 5).write_text("?")
    assert "cannot be read" in timed(lambda: None, tmp_path)[2].reason
