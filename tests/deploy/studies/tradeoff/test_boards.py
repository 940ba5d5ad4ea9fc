"""Tests of several boards in one study: their order changes nothing, and each board is recommended
or has the reason why not.
"""

from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.figures import unavailable
from beers_deploy.studies.tradeoff.front import Measured
from beers_deploy.studies.tradeoff.page import Tradeoff
from beers_deploy.studies.tradeoff.run import weigh
from tests.deploy.studies.tradeoff.synthetic import question, synthetic

BOARDS = ("fast", "frugal", "slow")
POWER_W = {"fast": 30.0, "frugal": 12.0, "slow": 20.0}


def weighed(
    points: Sequence[Measured],
    boards: Sequence[str],
    budget: str | None = None,
    need: str | None = None,
) -> Tradeoff:
    return weigh(points, boards, question(budget, need))


def on_boards(costs: dict[str, float], psnr_db: dict[str, float]) -> list[Measured]:
    """Return a point for each network and board, with the network's PSNR and a latency of both."""
    points = []
    for board, factor in costs.items():
        for name, quality_db in psnr_db.items():
            point = synthetic(
                name,
                quality_db,
                factor * (1 + quality_db - 44),
                board=board,
                power_w=POWER_W[board],
            )
            points.append(replace(point, name=f"{name} on {board}"))
    return points


NETWORKS = {"small": 44.0, "medium": 45.0, "large": 45.6}


@given(
    points=st.lists(
        st.tuples(
            st.sampled_from(BOARDS),
            st.sampled_from([44.0, 44.5, 45.0]),
            st.sampled_from([1.0, 2.0, 4.0]),
        ),
        min_size=1,
        max_size=8,
        unique=True,
    ),
    budget=st.sampled_from(
        [None, "latency<=2", "power<=15", "latency<=3,power<=25", "energy<=40", "host<=0.15"]
    ),
    need=st.sampled_from([None, "psnr>=44.4", "psnr>=46"]),
    data=st.data(),
)
def test_the_order_of_the_boards_changes_nothing(
    points: list[tuple[str, float, float]],
    budget: str | None,
    need: str | None,
    data: st.DataObject,
) -> None:
    """Many figures are equal, because a tie must not be won by the board that was named first."""
    candidates = [
        replace(
            synthetic("net", psnr_db, cost_s, board=board, power_w=POWER_W[board]),
            name=f"{board} {psnr_db} {cost_s}",
        )
        for board, psnr_db, cost_s in points
    ]
    one = weighed(candidates, BOARDS, budget, need)
    other = weighed(
        data.draw(st.permutations(candidates)), data.draw(st.permutations(BOARDS)), budget, need
    )
    assert other.line == one.line
    assert (other.best and other.best.name) == (one.best and one.best.name)
    assert [row.name for row in other.front_rows] == [row.name for row in one.front_rows]
    rows = [
        {row.name: (row.text, dict(row.figures)) for row in study.board_rows}
        for study in (one, other)
    ]
    assert rows[0] == rows[1]


def test_a_board_that_the_budget_excludes_hides_no_other() -> None:
    points = on_boards({"fast": 1.0, "slow": 3.0, "frugal": 40.0}, NETWORKS)
    study = weighed(points, BOARDS, "latency<=10s,power<=20W")
    assert study.best is not None
    assert study.best.name == "large on slow"
    assert study.board == "slow"
    assert {point.text["board"] for point in study.front} == {"slow"}
    words = dict(note.split(": ", 1) for note in study.notes[1:])
    assert words.keys() == set(BOARDS)
    limits = "no point keeps board latency <= 10 s and board power <= 20 W; nearest is small on"
    assert words["fast"].startswith(f"{limits} fast: board latency 1 [")
    assert words["frugal"].startswith(f"{limits} frugal: board latency 40 [")
    assert "this is the recommended point" in words["slow"]
    for row in study.front_rows:
        assert {"PSNR", "board latency", "board power", "board energy"} <= row.figures.keys()


@pytest.mark.parametrize(
    ("budget", "point", "words"),
    [
        ("latency<=30s", "large", "the PSNR of the recommended point, for 3 times its board lat"),
        ("latency<=4s", "small", "PSNR -1.6 [-1.6"),
    ],
)
def test_a_board_within_the_limits_is_compared_with_the_recommended_point(
    budget: str, point: str, words: str
) -> None:
    points = on_boards({"fast": 1.0, "slow": 3.0}, NETWORKS)
    row, _ = weighed(points, ["slow", "fast"], budget).board_rows
    assert row.text["point"] == f"{point} on slow"
    assert row.text["verdict"].startswith(words)
    assert row.figures["board power"].value == POWER_W["slow"]


def test_a_figure_or_network_that_a_board_lacks_is_reported_with_the_reason() -> None:
    points = on_boards({"fast": 1.0, "slow": 3.0}, NETWORKS)
    for point in points:
        if point.text["board"] == "slow":
            point.figures["board power"] = unavailable("W", "nobody measured it")
    _, slow = weighed(points, ["fast", "slow"], "power<=40").board_rows
    assert "no point has every figure asked for, such as board power" in slow.text["verdict"]
    odd = synthetic("odd", 45.0, 1.0, board="this machine")
    assert odd.point is not None
    misfit = replace(odd, point=replace(odd.point, reason="frugal: a sigmoid", refused_by="frugal"))
    _, frugal = weighed([*points, misfit], ["fast", "frugal"]).board_rows
    assert "odd does not fit its DPU: frugal: a sigmoid" in frugal.text["verdict"]
