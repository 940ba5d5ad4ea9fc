import ast

import pytest

from benchmarks import counts

CODE = '''"""A module's text."""

FIRST, SECOND = 1, 2  # why


def _lone() -> int:
    """A function's text."""
    return [x + y for x in range(3) for y in range(x)][0]


def main() -> int:
    one, other = divmod(7, 2)
    return one if other else (FIRST if one else _lone())
'''


def test_what_is_counted() -> None:
    tree = ast.parse(CODE)
    nodes = list(ast.walk(tree))
    totals = counts.measured(CODE, tree)
    assert (totals["lines"], totals["comments"]) == (13, 1)
    # There is one summand for each line with code.
    assert totals["tokens"] == 7 + 7 + 23 + 7 + 10 + 14
    assert sum(map(counts.is_paired, nodes)) == 1
    assert sum(map(counts.is_nested_conditional, nodes)) == 1
    assert counts.lone_helpers(nodes) == 1


@pytest.mark.parametrize("limit", [0.0, 1.0])
def test_an_exceeded_limit_is_reported(monkeypatch: pytest.MonkeyPatch, limit: float) -> None:
    totals = dict.fromkeys(counts.PARTS, counts.counted(("benchmarks/detector",)))
    monkeypatch.setattr(counts, "DENSITY_LIMITS", {"source": limit})
    monkeypatch.setattr(counts, "PACKED", {})
    (sentence,) = counts.over(totals)
    assert f"{limit:.2f} at most" in sentence


@pytest.mark.parametrize("field", counts.PACKED)
def test_packed_code_is_reported_in_any_part(field: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(counts, "DENSITY_LIMITS", {})
    clean = counts.counted(("benchmarks/detector",))
    packed = clean._replace(**{field: 2})
    assert list(counts.over({"benchmarks": clean})) == []
    (sentence,) = counts.over({"benchmarks": packed})
    assert sentence.startswith("benchmarks: 2 ")
