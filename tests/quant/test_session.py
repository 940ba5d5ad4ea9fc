"""Tests of a session's threads."""

import time

import numpy as np
import pytest

from beers_deploy.quant.session import open_session, run
from tests.quant.quick import uniform
from tests.shipped import shipped_pair

IMAGE = np.full((1, 1, 96, 96), 0.5, np.float32)


def idle_cpu_s(wait_s: float) -> float:
    """Return the CPU time that this process uses while it sleeps."""
    begun = time.process_time()
    time.sleep(wait_s)
    return time.process_time() - begun


def test_a_session_uses_no_cpu_time_after_its_run() -> None:
    """Threads that wait busily for the next run would slow a session that is timed after it."""
    session = open_session(shipped_pair()[1], threads=2)
    run(session, IMAGE)
    idle = []
    for _ in range(5):
        run(session, IMAGE)
        idle.append(idle_cpu_s(0.02))
    assert min(idle) < 0.004


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_number_of_threads_changes_no_bit(threads: int) -> None:
    image = uniform(1, 1, 53, 71)
    assert np.array_equal(
        run(open_session(shipped_pair()[1], threads), image),
        run(open_session(shipped_pair()[1]), image),
    )
