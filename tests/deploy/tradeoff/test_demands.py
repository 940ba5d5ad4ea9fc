"""`--budget` and `--need`: what they mean, and what is refused."""

import math

import pytest

from deploy.tradeoff.points import NAMES, Demand, parse_demands, shortfall
from profiles.errors import OptionError
from profiles.figures import measured, predicted, unavailable


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("latency<=20s", [Demand("board latency", True, 20, "s")]),
        ("latency <= 20", [Demand("board latency", True, 20, "s")]),
        ("PSNR>=44dB", [Demand("PSNR", False, 44, "dB")]),
        ("host<=0.5s/Mpx", [Demand("host p50", True, 0.5, "s/Mpx")]),
        ("efficiency>=1e5px/s/W", [Demand("board efficiency", False, 1e5, "px/s/W")]),
        ("psnr>=44, energy<=600J", [Demand("PSNR", False, 44, "dB"), Demand("board energy", True, 600, "J")]),
        ("host-p90<=3", [Demand("host p90", True, 3, "s/Mpx")]),
    ],
)
def test_demands_are_read(text: str, found: list[Demand]) -> None:
    assert parse_demands("--need", text) == found


def test_no_option_is_no_demand() -> None:
    assert parse_demands("--budget", None) == []


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_read_with_its_own_unit(name: str) -> None:
    key, unit = NAMES[name]
    assert parse_demands("--need", f"{name}>=1{unit}") == [Demand(key, False, 1, unit)]


@pytest.mark.parametrize("text", ["", "latency", "latency<20", "latency=20", "<=20", "latency<=fast", "a<=1,,b<=2"])
def test_what_is_no_demand_gets_one_sentence(text: str) -> None:
    with pytest.raises(OptionError, match=r"--budget: expected NAME<=NUMBER|one of psnr"):
        parse_demands("--budget", text)


def test_an_unknown_name_gets_the_list() -> None:
    with pytest.raises(OptionError, match=r"one of psnr, .*latency, .*efficiency, got 'speed'"):
        parse_demands("--budget", "speed<=3")


@pytest.mark.parametrize("text", ["latency<=20ms", "psnr>=44s", "energy<=3W"])
def test_another_unit_is_refused_and_never_guessed(text: str) -> None:
    with pytest.raises(OptionError, match="write"):
        parse_demands("--budget", text)


def test_a_miss_is_a_share_of_the_limit_and_what_is_unknown_keeps_nothing() -> None:
    most, least = Demand("board latency", True, 20, "s"), Demand("PSNR", False, 44, "dB")
    figures = {"board latency": predicted(25, "s", (20, 30), "model"), "PSNR": measured(45, "dB", "pairs")}
    assert most.short_by(figures["board latency"]) == 0.25
    assert least.short_by(figures["PSNR"]) == 0
    assert shortfall(figures, [most, least]) == 0.25
    assert shortfall(figures, []) == 0
    assert math.isinf(shortfall({"PSNR": unavailable("dB", "none")}, [least]))
    assert math.isinf(shortfall({}, [least]))


def test_a_limit_is_kept_throughout_only_by_the_whole_interval() -> None:
    most = Demand("board latency", True, 20, "s")
    assert most.kept_throughout(predicted(10, "s", (5, 20), "model"))
    assert not most.kept_throughout(predicted(10, "s", (5, 21), "model"))
    assert Demand("PSNR", False, 44, "dB").kept_throughout(measured(44, "dB", "pairs"))
