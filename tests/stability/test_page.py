"""docs/explanation/stability.md names every case, stage and limitation that the code knows."""

import re

from beers_deploy.studies.stress.cases import CASES
from beers_deploy.studies.stress.networks import STAGES
from docs.make import stability as maker


def test_the_page_is_fresh() -> None:
    """It has each case, each stage and each limitation, and nothing that failed."""
    page = maker.TARGET.read_text(encoding="utf-8")
    wanted = [maker.OPENING.strip(), *maker.stage_lines(), *maker.limitation_lines()]
    assert [text for text in wanted if text.strip() not in page] == []
    lines = re.findall(rf"^- {': .+?, '.join(STAGES)}: .+?\. (.+)\.$", page, re.MULTILINE)
    assert sorted(name for line in lines for name in line.split("; ")) == sorted(case.name for case in CASES)
    assert "FAILED" not in page
