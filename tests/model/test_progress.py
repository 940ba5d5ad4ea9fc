import pytest

from beers_deploy.model.progress import Step, progress, reporting, steps


def test_progress_is_a_call_or_a_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    heard = list[Step]()
    with reporting(heard.append), progress("making") as log:
        log("a part")
    assert [step.what for step in heard] == ["making: a part"]
    monkeypatch.setenv("FORCE_COLOR", "1")
    with steps("restoring", 3) as bar:
        bar.advance(3)
    with progress("making") as log:
        log("another")
    assert "restoring" in capsys.readouterr().err
