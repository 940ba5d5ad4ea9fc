"""docs/explanation/stability.md names every case, stage and limitation that the code knows."""

from types import ModuleType

import pytest

from deploy.studies.stress.cases import CASES
from deploy.studies.stress.networks import STAGES
from deploy.studies.stress.tables import markdown
from profiles.figures import Row, measured, predicted, unavailable
from tests.stability.makers import DOCS, load_maker


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    return load_maker("stability")


def faults(page: str, maker: ModuleType) -> list[str]:
    """What the page lacks, and what it has that failed."""
    wanted = [maker.OPENING.strip(), *maker.stage_lines(), *maker.limitation_lines()]
    lacking = [text for text in wanted if text.strip() not in page]
    lacking += [case.name for case in CASES if f"\n| {case.name} | " not in page]
    lacking += [] if f"|  | {' | '.join(STAGES)} |" in page else ["the stages of the table"]
    return lacking + (["a failure"] if "FAILED" in page else [])


def test_the_page_is_fresh(maker: ModuleType) -> None:
    assert faults((DOCS / "explanation" / "stability.md").read_text(encoding="utf-8"), maker) == []


def test_columns_say_unit_and_mode() -> None:
    rows = [
        Row("t", "a|b", {"x": measured(1.5, "DN", "s"), "y": predicted(2, "DN", (1, 3), "s")}),
        Row("t", "c", {"x": unavailable("DN", "no reason"), "y": measured(3, "px", "s")}),
    ]
    page = markdown(rows)
    assert "|  | x (DN, measured) | y |" in page
    assert "| a/b | 1.5 | 2 [1, 3] DN predicted |" in page
    assert "| c | - | 3 px measured |" in page
    assert "- x: no reason" in page
