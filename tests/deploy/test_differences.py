"""`compare`: what changed between two documents, and when that fails a job."""

from pathlib import Path

import pytest

from beers_deploy.differences import Change, parse_limit, read_document
from beers_deploy.profiles.figures import Check, Row, measured, predicted, unavailable
from beers_deploy.results import Table
from tests.deploy.command_line import done, refused


def document(
    path: Path, psnr: float = 46.5, mae: float = 0.0006, more: tuple[Row, ...] = ()
) -> Path:
    figures = {
        "PSNR": measured(psnr, "dB", "22 pairs"),
        "MAE": measured(mae, "of full scale", "patches"),
    }
    rows = (
        Row("gate", "network", figures),
        Row("bench", "network", {"latency": predicted(42, "s", (30, 60), "model")}),
    )
    checks = (Check("MAE", mae, 0.0007, "of full scale"),)
    Table("gate", {"model": "a.onnx"}, (), (*rows, *more), checks).save(path)
    return path


def test_the_same_document_has_not_changed(tmp_path: Path) -> None:
    one = document(tmp_path / "a.json")
    output = done("diff", one, one, "--fail-on", "PSNR<0", "--fail-on", "MAE>0%")
    assert "3 figures in both, 0 changed, 0 gone, 0 new" in output
    for table, words in (
        ("gate", "note: another command: gate, bench"),
        ("other", "got none in both"),
    ):
        row = Row(table, "network", {"PSNR": measured(46.5, "dB", "22 pairs")})
        Table("bench", {"model": "b.onnx"}, (one,), (row,)).save(tmp_path / "b.json")
        assert words in done("diff", one, tmp_path / "b.json", code=2 * (table == "other"))


@pytest.mark.parametrize(
    ("limit", "code"),
    [
        ("PSNR<-0.05", 1),
        ("PSNR<-0.2", 0),
        ("PSNR>0", 0),
        ("MAE>2%", 1),
        ("MAE>20%", 0),
        ("MAE<0", 0),
        ("latency>0", 0),
    ],
)
def test_a_limit_knows_its_direction_and_its_unit(limit: str, code: int, tmp_path: Path) -> None:
    before = document(tmp_path / "a.json")
    after = document(tmp_path / "b.json", psnr=46.4, mae=0.00066)
    output = done("diff", before, after, "--fail-on", limit, code=code)
    assert "2 changed" in output
    assert ("FAILED gate / network" in output) == bool(code)


def test_figures_that_come_and_go_are_counted_and_a_watched_one_that_goes_fails(
    tmp_path: Path,
) -> None:
    extra = Row(
        "gate",
        "other",
        {"SSIM": measured(0.99, "ratio", "pairs"), "LPIPS": unavailable("distance", "none")},
    )
    with_more = document(tmp_path / "a.json", more=(extra,))
    without = document(tmp_path / "b.json")
    assert "2 gone, 0 new" in done("diff", with_more, without)
    assert "0 gone, 2 new" in done("diff", without, with_more)
    done("diff", with_more, without, "--fail-on", "SSIM<-1", code=1)


def test_from_nothing_any_rise_is_endless() -> None:
    limit = parse_limit("saturated>5%")
    none = measured(0.0, "%", "seen")
    for value, is_broken in ((0.0, False), (1e-9, True)):
        assert (
            limit.broken_by(Change(("t", "n", "saturated"), none, measured(value, "%", "seen")))
            is is_broken
        )


def test_a_written_comparison_is_a_document_again(tmp_path: Path) -> None:
    before = document(tmp_path / "a.json")
    after = document(tmp_path / "b.json", psnr=40)
    done("diff", before, after, "--json", tmp_path / "c.json")
    assert read_document(tmp_path / "c.json")["command"] == "diff"


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), ("", "an empty file"), ("[]", "another document"), ("{}", "required")],
)
def test_what_is_no_document_gets_one_sentence(
    content: str | None, words: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "x.json").write_text(content)
    assert words in refused("diff", document(tmp_path / "a.json"), tmp_path / "x.json")


def test_a_watched_figure_that_can_no_longer_be_had_fails(tmp_path: Path) -> None:
    had, gone = (
        document(tmp_path / name, more=(Row("gate", "other", {"LPIPS": figure}),))
        for name, figure in (
            ("a.json", measured(0.01, "distance", "pairs")),
            ("b.json", unavailable("distance", "no weights")),
        )
    )
    done("diff", had, gone, "--fail-on", "LPIPS>1", code=1)
    done("diff", gone, had, "--fail-on", "LPIPS>1")


@pytest.mark.parametrize("text", ["PSNR", "PSNR=3", ">3", "PSNR<lots", "PSMR<0"])
def test_what_is_no_limit_or_of_no_figure_gets_one_sentence(text: str, tmp_path: Path) -> None:
    one = document(tmp_path / "a.json")
    message = "MAE, PSNR, latency" if text == "PSMR<0" else "NAME>CHANGE"
    assert message in refused("diff", one, one, "--fail-on", text)
