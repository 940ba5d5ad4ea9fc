from typing import Any, cast

import pytest

from beers_deploy.model.progress import Step, progress, reporting, step, steps
from beers_deploy.profiles.errors import OptionError


def test_progress_is_a_call_or_a_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    heard = list[Step]()
    with reporting(heard.append), progress("making"):
        step("a part")
    assert [each.what for each in heard] == ["making: a part"]
    monkeypatch.setenv("FORCE_COLOR", "1")
    with steps("restoring", 3) as bar:
        bar.advance(3)
    with progress("making"):
        step("another")
    assert "restoring" in capsys.readouterr().err
    with pytest.raises(OptionError, match="must be a function, False or None, got 'x'"):
        reporting(cast(Any, "x")).__enter__()
