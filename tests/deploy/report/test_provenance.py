from deploy.report.page import Provenance, grid_of
from profiles.figures import Row, measured, predicted, unavailable


def rows() -> list[Row]:
    here, model = "a stopwatch", "a model"
    return [
        Row("t", "a", {"x": measured(1.25, "s", here), "y": predicted(2, "J", (1, 3), model)}, {"word": "one"}),
        Row("t", "b", {"x": unavailable("s", "no clock"), "z": measured(4, "ratio", here)}),
    ]


def test_figures_of_one_source_share_its_number() -> None:
    provenance = Provenance()
    a, b = grid_of(rows(), provenance).lines
    assert [cell.note.tag if cell else "" for cell in a.cells] == ["1", "2", ""]
    assert [cell.note.tag if cell else "" for cell in b.cells] == ["r1", "", "1"]
    assert [note.text for note in provenance.sources.values()] == ["a stopwatch", "a model"]
    assert [list(note.keys) for note in provenance.sources.values()] == [["x", "z"], ["y"]]
    assert [note.text for note in provenance.reasons.values()] == ["no clock"]


def test_numbers_go_on_from_table_to_table() -> None:
    provenance = Provenance()
    grid_of(rows(), provenance)
    (line,) = grid_of([Row("u", "c", {"x": measured(1, "s", "a sundial")})], provenance).lines
    assert line.cells[0] is not None
    assert line.cells[0].note.anchor == "source-3"


def test_cells_keep_all_digits_to_sort_by() -> None:
    grid = grid_of(rows(), Provenance())
    first, second = (line.cells for line in grid.lines)
    assert first[0] is not None
    assert (first[0].text, first[0].unit, first[0].value) == ("1.25", "s", "1.25")
    assert first[1] is not None
    assert (first[1].text, first[1].interval) == ("2", "[1, 3]")
    assert second[0] is not None
    assert (second[0].mode, second[0].value) == ("unavailable", "")
    assert grid.units == ("s", "J", "ratio")
    assert [line.words for line in grid.lines] == [("one",), ("",)]
