"""docs/explanation/stability.md names every case, stage and limitation that the code knows."""

from beers_deploy.profiles.figures import Row, measured, predicted, unavailable
from beers_deploy.studies.stress.battery import markdown
from beers_deploy.studies.stress.cases import CASES
from beers_deploy.studies.stress.networks import STAGES
from docs.make import stability as maker


def test_the_page_is_fresh() -> None:
    """It has each case, each stage and each limitation, and nothing that failed."""
    page = maker.TARGET.read_text(encoding="utf-8")
    wanted = [maker.OPENING.strip(), *maker.stage_lines(), *maker.limitation_lines(), f"|  | {' | '.join(STAGES)} |"]
    assert [text for text in wanted if text.strip() not in page] == []
    assert [case.name for case in CASES if f"\n| {case.name} | " not in page] == []
    assert "FAILED" not in page


def test_columns_say_unit_and_mode() -> None:
    rows = [
        Row("worst", "a|b", {"x": measured(1.5, "DN", "s"), "y": predicted(2, "DN", (1, 3), "s")}),
        Row("worst", "c", {"x": unavailable("DN", "no reason"), "y": measured(3, "px", "s")}),
    ]
    page = markdown(rows)
    assert "|  | x (DN, measured) | y |" in page
    assert "| a/b | 1.5 | 2 [1, 3] DN predicted |" in page
    assert "| c | - | 3 px measured |" in page
    assert "- x: no reason" in page
