import sys
from pathlib import Path

import pytest

from deploy.dpu.cost.published import boards

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_and_the_profiles_are_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run `python docs/make_cost_model.py` if this fails."""
    monkeypatch.syspath_prepend(str(DOCS))
    import make_cost_model  # type: ignore[import-not-found]

    for board in boards():
        profile = (make_cost_model.TARGETS / f"{board}.toml").read_text(encoding="utf-8")
        assert make_cost_model.with_cost(profile, board) == profile
    assert make_cost_model.page() == make_cost_model.PAGE.read_text(encoding="utf-8")
    sys.modules.pop("make_cost_model")
