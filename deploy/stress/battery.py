"""Every case through every stage: what was measured, and what it is judged to be."""

import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from deploy.stress.cases import CASES, SIDE_PX, Case
from deploy.stress.checks import Limitation, Measure, limitation_of, torch_threads
from deploy.stress.networks import bfloat16, float32, plans, reference, runtime
from deploy.stress.science import losses, metrics, simulator, traditional
from deploy.stress.subject import Subject
from profiles.errors import BeersError, OptionError

Look = Callable[[Subject, Case, np.ndarray], list[Measure]]

STAGES: dict[str, Look] = {
    "simulator": simulator,
    "traditional": traditional,
    "float32": float32,
    "bfloat16": bfloat16,
    "INT8": runtime,
    "INT8 reference": reference,
    "tiling": plans,
    "metrics": metrics,
    "losses": losses,
}


@dataclass(frozen=True)
class Outcome:
    """One case at one stage: the worst of each check over its images, or why the stage was not looked at."""

    case: Case
    stage: str
    measures: tuple[Measure, ...]
    reason: str = ""

    @property
    def limitations(self) -> list[Limitation]:
        """The known limitations that explain what does not hold."""
        found = [limitation_of(self.stage, self.case.name, m) for m in self.measures if not m.holds]
        return list(dict.fromkeys(limit for limit in found if limit is not None))

    @property
    def failed(self) -> list[Measure]:
        """What does not hold, and no limitation explains."""
        return [m for m in self.measures if not m.holds and limitation_of(self.stage, self.case.name, m) is None]

    @property
    def verdict(self) -> str:
        """In a word or two."""
        if self.failed:
            return "FAILED: " + ", ".join(measure.check for measure in self.failed)
        if self.limitations:
            return "limit: " + ", ".join(limit.name for limit in self.limitations)
        return "ok" if self.measures else "-"


def run_battery(
    subject: Subject,
    cases: Sequence[Case] = CASES,
    stages: Sequence[str] = tuple(STAGES),
    seed: int = 0,
    tick: Callable[[], None] = lambda: None,
    side_px: int = SIDE_PX,
) -> list[Outcome]:
    """Look at every case at every stage; `tick` is called once for each such pair."""
    outcomes = []
    with torch_threads(1):  # on images this small a second thread only waits
        for case in cases:
            # Seeded by its name: a case draws the same images whichever others are asked for.
            images = case.draw(side_px, np.random.default_rng([seed, zlib.crc32(case.name.encode())]))
            for stage in stages:
                outcomes.append(_outcome(subject, case, stage, images))
                tick()
    return outcomes


def _outcome(subject: Subject, case: Case, stage: str, images: Iterable[np.ndarray]) -> Outcome:
    try:
        found = [measure for image in images for measure in STAGES[stage](subject, case, image)]
    except BeersError as error:
        return _refused(case, stage, error)
    return Outcome(case, stage, tuple(worst(found)))


def _refused(case: Case, stage: str, error: BeersError) -> Outcome:
    """A stage that cannot be looked at says so; one that refuses a sound image has failed."""
    if stage in ("bfloat16", "INT8", "INT8 reference") and error.where in (
        "float model",
        "INT8 network",
        "INT8 core",
    ):
        return Outcome(case, stage, (), str(error))
    return Outcome(case, stage, (Measure(f"refused: {error}", 1, 0, "runs"),))


def worst(measures: Iterable[Measure]) -> list[Measure]:
    """Of each check the measure that is largest beside what is allowed; NaN is the worst."""
    found: dict[str, Measure] = {}
    for measure in measures:
        before = found.get(measure.check)
        if before is None or _excess(measure) > _excess(before):
            found[measure.check] = measure
    return list(found.values())


def _excess(measure: Measure) -> float:
    return math.inf if math.isnan(measure.value) else measure.value - measure.allowed


def chosen(names: str | None, known: Iterable[str], option: str) -> list[str]:
    """The names in a list with commas; all where none is given.

    Raises:
        OptionError: an unknown one.
    """
    every = list(known)
    wanted = every if names is None else [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in every:
            expected = f"some of {', '.join(every)}"
            raise OptionError(option, expected=expected, got=repr(name), remedy="separate them by commas")
    return wanted
