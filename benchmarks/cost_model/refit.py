"""Refit the cost model: `python -m benchmarks.cost_model.refit` writes [cost] of every board with
published rates.

It prints the errors on families that the fit has not seen, for each board: the table of
docs/explanation/cost-model.md. `--check` writes nothing, and reports whether the profiles have the
constants of the fit.
"""

import argparse
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import permutations
from pathlib import Path

import numpy as np

from beers_deploy.dpu.cost.latency import WIDTHS
from beers_deploy.dpu.cost.model import PARTS
from benchmarks.cost_model.fit import fit, rounded
from benchmarks.cost_model.notation import KINDS
from benchmarks.cost_model.published import NETWORKS, boards, host_cores, written
from benchmarks.cost_model.validation import (
    Nested,
    by_network,
    corrected,
    coverage,
    nested,
    outside_width,
    pair_width,
    rank_correlation,
    settled,
)

TARGETS = Path(__file__).parents[2] / "profiles" / "targets"
HEADER = "[cost] # written by benchmarks/cost_model/refit.py; the formula: deploy/dpu/cost/model.py"
CHOSEN = "the choice of least error on families left out: benchmarks/cost_model/validation.py"
FITTED = (
    "fit to the published rates of {rows} networks and configurations, "
    "benchmarks/cost_model/zoo/published.csv"
)


def with_cost(profile: str, board: str) -> str:
    """Return the text of a profile with a new [cost]."""
    lines = [HEADER]
    lines += [
        f'{key} = {{ value = {value}, status = "{status}", source = "{source}" }}'
        for key, value, status, source in cost_table(board)
    ]
    block = "\n".join(lines) + "\n"
    return re.sub(
        r"^\[cost].*?\n(?=\n|\Z)", lambda _: block, profile, flags=re.DOTALL | re.MULTILINE
    )


def cost_table(board: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield key, value, status and source of each constant of a board's [cost]."""
    validation = nested(board)
    source = FITTED.format(rows=len(validation.cases.rows))
    for key, value in asdict(rounded(fit(validation.cases))).items():
        yield key, f"{value:.4g}", "inferred", source
    yield (
        "overlap",
        f"{validation.cases.structure.overlap:g}",
        "assumed",
        "benchmarks/cost_model/validation.py, OVERLAP",
    )
    yield (
        "contention_exponent",
        f"{validation.cases.structure.contention_exponent:g}",
        "inferred",
        CHOSEN,
    )
    families = len(set(validation.cases.families))
    left_out = (
        "|ln(predicted / published)| that nine of ten families keep to, from "
        f"{families}, each left out once"
    )
    for part, width in zip(PARTS, validation.widths, strict=True):
        yield WIDTHS[part], f"{width:.3f}", "inferred", f"{left_out}; {part}"
    covered = (
        "share of the families, each left out of fit and widths, that their intervals held "
        "with every rate"
    )
    yield "families_held", f"{coverage(validation.rows)[1]:.2f}", "inferred", covered
    off = by_network(validation.rows)
    mean_error = "mean |predicted / published - 1| of the networks, each left out with its family"
    yield "error_left_out", f"{off.mean():.3f}", "inferred", mean_error
    on_dpu = validation.widths[: PARTS.index("copies")]
    widest = max(*on_dpu, outside_width(validation.cases))
    far = (
        "the widest of the DPU's parts, or the error of networks with the largest maps, predicted "
        "from those with a quarter"
    )
    yield WIDTHS["outside"], f"{widest:.3f}", "inferred", far
    pairs = (
        "|ln of the ratio of two rates, predicted / published| that nine of ten pairs of a "
        "family's networks keep to"
    )
    yield (
        "pair_width",
        f"{pair_width(board):.3f}",
        "inferred",
        f"{pairs}, each network left out once",
    )
    for key, (low, high) in fitted_ranges(validation).items():
        range_of = "range of the fitted networks that the DPU bounds"
        yield f"fitted_{key}", f"[{low:.4g}, {high:.4g}]", "inferred", range_of


def fitted_ranges(validation: Nested) -> dict[str, tuple[float, float]]:
    """Return the ranges of the networks whose rate the DPU sets."""
    bound = {row.network for row in validation.rows if not row.on_host}
    maps = [row.map_bytes for row in validation.cases.rows if row.network in bound]
    works = [sum(op.operations for op in written(name).network.operations) for name in bound]
    return {"map_bytes": (min(maps), max(maps)), "operations": (min(works), max(works))}


def accuracy() -> Iterator[tuple[object, ...]]:
    """Yield a row for each board: errors of networks whose family was left out, and the coverage
    of the intervals.
    """
    inside = "rates inside", "families", "settled", "right"
    yield "board", "median", "mean", "largest", *inside, "Spearman"
    for board in boards():
        validation = nested(board)
        off = by_network(validation.rows)
        shares = *coverage(validation.rows), *settled(validation.rows)
        rank = f"{rank_correlation(validation):.3f}"
        yield board, *_spread(off), *map(_percent, shares), rank


def by_kind() -> Iterator[tuple[object, ...]]:
    """Yield a row for each board and kind of network: errors with the family left out."""
    yield "board", "kind", "networks", "mean"
    for board in boards():
        for kind in dict.fromkeys(KINDS.values()):
            rows = [row for row in nested(board).rows if NETWORKS[row.network].kind == kind]
            if not rows:
                continue
            off = by_network(rows)
            yield board, kind, len(off), _percent(float(off.mean()))


def by_kinship() -> Iterator[tuple[object, ...]]:
    """Yield a row for each kinship: the gain by one run, on its own board and across boards."""
    yield "run on", "predicted on", "kinship", "pairs", "without", "with", "inside"
    zynq = [board for board in boards() if host_cores(board) == host_cores("zcu102")]
    for owner, board in [*((name, name) for name in boards()), *permutations(zynq, 2)]:
        for kin, gain in corrected(owner, board).items():
            shares = map(_percent, (gain.before, gain.after, gain.held))
            yield (owner, board, kin, gain.pairs, *shares)


def _spread(off: np.ndarray) -> list[str]:
    return [_percent(float(value)) for value in (np.median(off), off.mean(), off.max())]


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share < 0.2 else f"{100 * share:.0f} %"


def table(rows: Iterable[Iterable[object]]) -> str:
    """Return a table in Markdown from its head and its rows."""
    head, *lines = [list(map(str, row)) for row in rows]
    return (
        "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines)) + "\n"
    )


def main() -> int:
    """Write or check [cost] of all boards; 1 where `--check` finds another."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument(
        "--check", action="store_true", help="write nothing, and say which profile differs"
    )
    check = parser.parse_args().check
    stale = []
    for board in boards():
        path = TARGETS / f"{board}.toml"
        text = path.read_text(encoding="utf-8")
        new = with_cost(text, board)
        stale += [board] if new != text else []
        if not check:
            path.write_text(new, encoding="utf-8", newline="\n")
    print(f"{'not as fitted' if check else 'rewritten'}: {', '.join(stale) or 'none'}\n")
    print(table(accuracy()))
    print(table(by_kind()))
    print(table(by_kinship()))
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
