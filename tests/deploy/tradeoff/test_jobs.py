"""Jobs run in order, and say how much time is left."""

import pytest

from deploy.tradeoff.measurements import Job, Tick, run_jobs, time_left


def test_jobs_run_in_order_and_the_last_line_says_that_all_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    ran = []

    def job(name: str) -> Job:
        def run(tick: Tick) -> None:
            ran.append(name)
            for _ in range(3):
                tick()

        return Job(name, 2.5, 3, run)

    run_jobs([job("a"), job("b"), job("c")])
    assert ran == ["a", "b", "c"]
    assert "100/100" in capsys.readouterr().err


def test_no_jobs_say_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    run_jobs([])
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("done", "elapsed_s", "words"),
    [(0, 100, ""), (1, 3, ""), (10, 60, "about 9 min"), (90, 360, "about 40 s"), (100, 60, "about 0 s")],
)
def test_time_left_goes_by_the_pace_so_far(done: float, elapsed_s: float, words: str) -> None:
    assert time_left(done, 100, elapsed_s) == words
