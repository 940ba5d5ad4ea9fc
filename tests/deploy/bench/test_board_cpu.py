"""The chain on a board's processor: kinds that explain the time here, and an interval that says something."""

import math
from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.bench.board_cpu import (
    BOUND_BY,
    CpuTime,
    board_cpu_row,
    board_latency_s,
    chain_time,
    kind_rows,
    kind_slowdowns,
    slowdowns,
)
from deploy.bench.rates import Rates, measured_rates
from deploy.bench.tables import Swath
from model.traditional.settings import QUALITIES
from model.traditional.work import UNITS, chain_work
from profiles import TargetProfile, load_target, target_names
from profiles.constant import Constant, Number
from profiles.errors import ProfileError
from profiles.figures import Row

# Of one core of a Zen 4 server under load, 25 turns of each kernel; and the chain's CPU time on it, then.
MEASURED = Rates(
    {
        "box sums": 4.71e10,
        "group products": 3.38e10,
        "factorisations": 2.84e9,
        "selection": 8.21e7,
        "transforms": 1.44e10,
        "passes": 4.68e10,
        "strided": 5.24e9,
        "gathers": 9.74e9,
        "calls": 4.27e5,
    },
    {"products": 9.00e10, "integers": 4.70e9, "memory": 4.68e10},
)
MEASURED_S = {"fast": 0.297, "standard": 0.470, "best": 0.875}
MEASURED_PX = 256

BOARDS = [name for name in target_names() if "cpu" in load_target(name).tables]
SWATH = Swath(13600, 9016)
WORK = chain_work(SWATH.height_px, SWATH.width_px, QUALITIES["standard"])
RATE = st.floats(0.2, 5.0)


def value(row: Row, key: str) -> float:
    number = row.figures[key].value
    assert number is not None
    return number


def changed(board: TargetProfile, **values: Number) -> TargetProfile:
    cpu = board.tables["cpu"] | {key: Constant(number, "stated", "test") for key, number in values.items()}
    return replace(board, tables=board.tables | {"cpu": cpu})


def chain(rates: Rates = MEASURED, explained: float = 0.9, cpu_s: float = 800.0) -> CpuTime:
    return chain_time((cpu_s, cpu_s), WORK, rates, explained)


@pytest.mark.parametrize("name", sorted(QUALITIES))
def test_the_kinds_explain_the_chains_time_within_a_quarter(name: str) -> None:
    counted_s = math.fsum(MEASURED.times_s(chain_work(MEASURED_PX, MEASURED_PX, QUALITIES[name])).values())
    assert 1 / 1.25 < counted_s / MEASURED_S[name] < 1.25


@pytest.mark.parametrize("name", sorted(QUALITIES))
def test_no_kind_is_most_of_the_chain(name: str) -> None:
    """So that one rate measured wrong cannot carry the sum."""
    shares = chain_time((1, 1), chain_work(1024, 1024, QUALITIES[name]), MEASURED, 1.0).shares
    assert math.fsum(shares.values()) == pytest.approx(1)
    assert all(0 < share < 1 / 3 for share in shares.values())


@pytest.mark.parametrize("name", BOARDS)
@pytest.mark.parametrize("explained", [0.7, 1.0, 1.2])
def test_the_interval_is_within_a_factor_of_four(name: str, explained: float) -> None:
    low, high = board_latency_s(chain(explained=explained), load_target(name), MEASURED)
    assert 1.3 < high / low <= 4


@given(st.lists(RATE, min_size=len(UNITS), max_size=len(UNITS)), RATE, RATE, RATE)
def test_whatever_the_processor_here_the_ends_are_sums_over_kinds(
    kinds: list[float], products: float, memory: float, integers: float
) -> None:
    scale = dict(zip(UNITS, kinds, strict=True))
    resources = {"products": products, "memory": memory, "integers": integers}
    rates = Rates(
        {kind: rate * scale[kind] for kind, rate in MEASURED.kinds.items()},
        {name: rate * resources[name] for name, rate in MEASURED.resources.items()},
    )
    board = load_target("vck190")
    time, by_kind = chain(rates, explained=1.0), kind_slowdowns(board, rates)
    serial, cores = time.serial, board.value("cpu", "cores")
    for end, latency_s in enumerate(board_latency_s(time, board, rates)):
        one_core_s = math.fsum(800 * time.shares[kind] * by_kind[kind][end] for kind in UNITS)
        assert latency_s == pytest.approx(one_core_s * (serial[end] + (1 - serial[end]) / cores))


def test_what_is_not_explained_may_be_of_any_kind() -> None:
    board = load_target("vck190")
    known, partly, unknown = (board_latency_s(chain(explained=share), board, MEASURED) for share in (1.0, 0.6, 0.0))
    assert unknown[0] < partly[0] < known[0] < known[1] < partly[1] < unknown[1]
    assert board_latency_s(chain(explained=1.3), board, MEASURED) == pytest.approx(known)


@pytest.mark.parametrize("name", BOARDS)
@given(factor=st.floats(1.1, 3))
def test_a_board_is_faster_with_its_clock_and_its_cores(name: str, factor: float) -> None:
    board = load_target(name)
    clock, cores = board.constant("cpu", "clock_ghz"), board.value("cpu", "cores")
    base = board_latency_s(chain(), board, MEASURED)
    faster = changed(board, clock_ghz=(clock.low * factor, clock.high * factor))
    for end, latency_s in enumerate(board_latency_s(chain(), faster, MEASURED)):
        assert base[end] / factor < latency_s < base[end]  # the memory keeps its own
    for end, latency_s in enumerate(board_latency_s(chain(), changed(board, cores=2 * cores), MEASURED)):
        assert base[end] / 2 < latency_s < base[end]  # what one core does alone stays


def test_of_two_boards_with_the_same_cores_the_faster_clock_is_faster() -> None:
    boards = [load_target(name) for name in BOARDS]
    for one, other in permutations(boards, 2):
        keys = ("cores", "product_flops_per_cycle", "decoding_mips_per_ghz")
        alike = all(one.constant("cpu", key).value == other.constant("cpu", key).value for key in keys)
        clocks = [board.constant("cpu", "clock_ghz").high for board in (one, other)]
        slow, fast = (board_latency_s(chain(), board, MEASURED) for board in (one, other))
        assert not (alike and clocks[0] < clocks[1]) or (fast[0] < slow[0] and fast[1] < slow[1])


@given(st.floats(0.1, 1e4), st.floats(1, 3))
def test_the_time_there_is_in_proportion_to_that_here(cpu_s: float, spread: float) -> None:
    board = load_target("vck190")
    low, high = board_latency_s(chain(cpu_s=1.0), board, MEASURED)
    time = chain_time((cpu_s, spread * cpu_s), WORK, MEASURED, 0.9)
    assert board_latency_s(time, board, MEASURED) == pytest.approx((low * cpu_s, high * spread * cpu_s))


def test_a_method_of_no_known_kind_may_use_one_core_or_all() -> None:
    board = load_target("vck190")
    found, by_kind = board_latency_s(CpuTime((10, 12), {}), board, MEASURED), kind_slowdowns(board, MEASURED).values()
    fastest, slowest = min(low for low, _ in by_kind), max(high for _, high in by_kind)
    assert found == pytest.approx((10 * fastest / board.value("cpu", "cores"), 12 * slowest))


@pytest.mark.parametrize("name", BOARDS)
def test_the_row_carries_an_interval_and_hangs_together(name: str) -> None:
    board = load_target(name)
    row = board_cpu_row(chain(), SWATH, board, MEASURED)
    latency = row.figures["latency"]
    assert latency.mode == "predicted"
    assert latency.interval == board_latency_s(chain(), board, MEASURED)
    assert latency.interval[0] < value(row, "latency") < latency.interval[1]
    assert value(row, "throughput") * value(row, "latency") == pytest.approx(SWATH.frames)
    if "cpu_run_w" in board.tables.get("power", {}):
        assert row.figures["power"].mode == "published"
        assert row.figures["efficiency"].mode == "predicted"
    else:
        assert row.figures["power"].reason == row.figures["efficiency"].reason != ""


def test_a_row_for_each_kind_says_what_it_is_scaled_by() -> None:
    board, time = load_target("vck190"), chain()
    rows = kind_rows(time, WORK, board, MEASURED)
    assert list(BOUND_BY) == list(UNITS)
    assert [row.name for row in rows] == [f"{kind}, {unit}" for kind, unit in UNITS.items()]
    counted_s = MEASURED.times_s(WORK)
    for kind, row in zip(UNITS, rows, strict=True):
        assert value(row, "work") / value(row, "rate") == pytest.approx(counted_s[kind])
        share = 100 * 0.9 * counted_s[kind] / math.fsum(counted_s.values())
        assert value(row, "share") == pytest.approx(share)
    for row in rows:
        ends = [slowdowns(board, MEASURED)[name] for name in row.text["bound"].split(" or ")]
        assert row.figures["slower there"].interval == (min(e[0] for e in ends), max(e[1] for e in ends))


def test_a_target_without_a_processor_is_one_sentence() -> None:
    with pytest.raises(ProfileError, match=r"\[cpu\] clock_ghz"):
        board_latency_s(chain(), replace(load_target("vck190"), tables={}), MEASURED)


def test_rates_of_this_processor_are_asked_once_and_are_of_every_kind() -> None:
    rates = measured_rates()
    assert rates is measured_rates()
    assert set(rates.kinds) == set(UNITS) == set(BOUND_BY)
    assert all(rate > 0 for rate in (*rates.kinds.values(), *rates.resources.values()))
    assert {name for names in BOUND_BY.values() for name in names} == set(rates.resources)
