"""Calls are run round by round, and each round's measurements come back in order."""

from collections.abc import Callable, Sequence

from deploy.bench.timing import interleaved


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
