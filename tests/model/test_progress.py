import pytest

from beers_deploy.model.progress import Step, progress, reporting, step, steps


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
