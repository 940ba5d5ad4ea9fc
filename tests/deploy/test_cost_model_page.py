import pytest

from deploy.dpu.cost.published import boards
from docs.make import cost_model


@pytest.mark.slow
def test_the_page_and_the_profiles_are_fresh() -> None:
    """Run `python docs/make/cost_model.py` if this fails."""
    for board in boards():
        profile = (cost_model.TARGETS / f"{board}.toml").read_text(encoding="utf-8")
        assert cost_model.with_cost(profile, board) == profile
    assert cost_model.page() == cost_model.PAGE.read_text(encoding="utf-8")
