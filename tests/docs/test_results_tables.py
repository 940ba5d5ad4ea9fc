"""Tests that the tables of docs/results are filled from a document of results."""

from typing import Any

import pytest

from docs.make.results import MARKED, filled


def figure(value: float | None, unit: str, interval: list[float] | None = None) -> dict[str, Any]:
    return {
        "value": value,
        "unit": unit,
        "mode": "measured",
        "interval": interval,
        "source": "a test",
    }


def row(table: str, name: str, **figures: Any) -> dict[str, Any]:
    return {"table": table, "name": name, "figures": figures, "text": {"sensor": "known"}}


def fill(table: str, heading: str, *rows: dict[str, Any], old: str = "") -> str:
    page = f"before\n<!-- {table} -->\n{heading}\n|---|\n{old}<!-- end -->\nafter\n"
    return MARKED.sub(lambda match: filled({table: list(rows)}, match), page)


@pytest.mark.parametrize("table", ["mean", "mean, radiance x 0.25"])
def test_tables_of_means_have_the_rows_and_columns_that_the_page_names(table: str) -> None:
    means = {"PSNR": figure(47.123, "dB", [46.0, 48.5]), "bias of the mean": figure(-0.0149, "%")}
    heading = "| method | sensor | bias of the mean % | PSNR dB |"
    page = fill(
        table,
        heading,
        row(table, "net", **means, SSIM=figure(0.9, "ratio")),
        row(table, "paper: net", **means),
        old="| net | known | 0 | 0 [0, 0] |\n",
    )
    assert page.splitlines()[2:5] == [
        heading,
        "|---|---|---|---|",
        "| net | known | -0.01 | 47.12 [46.00, 48.50] |",
    ]
    assert "paper" not in page


def test_the_table_of_targets_is_filled() -> None:
    figures = {
        "zone plate of 8%": figure(0.5499, "of the reference", [0.5288, 0.5711]),
        "flux": figure(98, "%"),
    }
    heading = "| method | sensor | zone plate of 8% of the reference |"
    page = fill("targets", heading, row("targets", "net", **figures))
    assert page.splitlines()[2:5] == [heading, "|---|---|---|", "| net | known | 0.55 |"]


def test_a_table_of_differences_keeps_its_empty_corner() -> None:
    figures = {"net-int8": figure(0.472, "dB", [0.151, 0.999])}
    rows = [row("sweep", name, **figures) for name in ("MTF 7%", "MTF 5%")]
    page = fill("sweep", "|  | net-int8 |", *rows, old="| MTF 5% | 0 [0, 0] |\n")
    assert page.splitlines()[2:6] == [
        "|  | net-int8 |",
        "|---|---|",
        "| MTF 5% | 0.47 [0.15, 1.00] |",
        "<!-- end -->",
    ]


def test_a_table_that_the_document_lacks_does_not_change() -> None:
    page = "<!-- targets -->\n| method |\n|---|\n| old |\n<!-- end -->\n"
    assert MARKED.sub(lambda match: filled({"mean": []}, match), page) == page
