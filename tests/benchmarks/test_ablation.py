"""Test that the ablation runs and shows the gain of each pass."""

import pytest

from benchmarks import ablation

pytestmark = pytest.mark.slow


def test_one_small_network_gets_a_row_in_which_passes_matter(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["ablation", "--only", "HardSwish", "--steps", "4", "--batches", "1"]
    monkeypatch.setattr("sys.argv", words)
    ablation.main()
    head, _, row = capsys.readouterr().out.strip().splitlines()
    names = [cell.strip() for cell in head.strip("|").split("|")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    gains = dict(zip(names[2:], map(float, cells[2:]), strict=True))
    assert cells[0] == "depthwise, HardSwish"
    assert float(cells[1]) < 3
    assert set(gains) == {"long_skip", "dual_range", "least_squares", "equalization"}
    # Four steps make a poor network, whose integers still depend on how they are chosen.
    assert sum(gain != 0 for gain in gains.values()) >= 2
