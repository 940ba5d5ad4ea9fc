"""What boards change: the INT8 files made for each, and how far off the time of one thread is.

    python benchmarks/boards.py files --images aerial-train/
    python benchmarks/boards.py one-thread

`files` calibrates every shipped network once for each board, on the same patches, checks each file on its board and
says whether the integers are those of the first board, and those of the shipped file. `one-thread` fits the published
rates of each board without one family after the other, and compares what it then says of a single thread with what is
published; structure and widths are those of the board's [cost], which the family was not kept from.
"""

import argparse
import hashlib
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx

from deploy.dpu.board import dpu_of, load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.constants import Array, Structure
from deploy.dpu.cost.fit import Cases, fit
from deploy.dpu.cost.latency import WIDTHS
from deploy.dpu.cost.published import boards, published_cases
from deploy.dpu.cost.validation import regimes_of
from deploy.dpu.reading import network_of
from deploy.networks import Conditioned, family_model
from model.shipped import INT8, SHIPPED, shipped_names, shipped_weights
from profiles import load_target
from profiles.target import board_names
from quant.core import target_shifts
from quant.onnx_file import load_onnx


def files(images: Path | None, variants: list[str]) -> None:
    """A line a network and board."""
    for variant in variants:
        network, first = Conditioned(variant, shipped_weights(variant)), ""
        shipped = integers(load_onnx(SHIPPED / f"{variant}{INT8}.onnx"))
        for name in board_names():
            start, target = time.perf_counter(), load_target(name)
            made = family_model(network, images, shifts=target_shifts(target))
            found = integers(made)
            first = first or found
            refused = len(place(network_of(made, 640), dpu_of(target)).failed)
            print(
                f"{variant:14} {name:8} {time.perf_counter() - start:5.0f} s, nodes refused {refused}, "
                f"{found[:12]}, {'as' if found == first else 'NOT as'} the first board's, "
                f"{'as' if found == shipped else 'not as'} shipped",
                flush=True,
            )


def integers(model: onnx.ModelProto) -> str:
    """SHA-256 of a file's graph: what it computes, without what is said beside it."""
    return hashlib.sha256(model.graph.SerializeToString(deterministic=True)).hexdigest()


def one_thread() -> None:
    """A line a board."""
    for board in boards():
        cases = published_cases(board, Structure.of(load_dpu(board)))
        several, single = left_out(cases)
        print(f"{board:8} {shares(board, cases, single)}; several threads: mean {mean(cases, several):.1%}")


def left_out(cases: Cases) -> tuple[Array, Array]:
    """ln(predicted / published) with several threads and with one (n,), NaN where none is published."""
    families, near = np.array([row.family for row in cases.rows]), fit(cases)
    found = np.full((2, len(families)), np.nan)
    for family in dict.fromkeys(families):
        out = families == family
        kept = cases.only(out)
        found[:, out] = kept.residuals(kept.times(fit(cases.only(~out), near=near))).reshape(2, -1)
    return found[0], np.where(np.isnan(cases.observed_single), np.nan, found[1])


def by_network(cases: Cases, errors: Array) -> Mapping[str, float]:
    """Mean relative error of each network's rates."""
    names = np.array([row.network for row in cases.rows])
    known = ~np.isnan(errors)
    return {
        name: float(np.abs(np.expm1(errors[known & (names == name)])).mean()) for name in dict.fromkeys(names[known])
    }


def mean(cases: Cases, errors: Array) -> float:
    """Over networks."""
    return float(np.mean(list(by_network(cases, errors).values())))


def shares(board: str, cases: Cases, errors: Array) -> str:
    """Errors over networks, and how much lies inside the widths of the board's rates."""
    dpu, known = load_dpu(board), ~np.isnan(errors)
    widths = np.array([dpu.value("cost", WIDTHS[kind]) for kind in regimes_of(cases, fit(cases))])
    inside = np.abs(errors) <= widths
    families = np.array([row.family for row in cases.rows])
    whole = [inside[known & (families == family)].all() for family in dict.fromkeys(families[known])]
    each = list(by_network(cases, errors).values())
    return (
        f"{len(each)} networks, {known.sum()} rates: median {np.median(each):.1%}, mean {np.mean(each):.1%}, largest "
        f"{max(each):.0%}; inside {inside[known].mean():.0%} of rates, {np.mean(whole):.0%} of {len(whole)} families"
    )


def main() -> None:
    """Run one of the two."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("files", "one-thread"))
    parser.add_argument("--images", type=Path, help="folder of scenes; drawn ones if none")
    parser.add_argument("--variants", nargs="+", default=shipped_names())
    given = parser.parse_args()
    if given.what == "files":
        files(given.images, given.variants)
    else:
        one_thread()


if __name__ == "__main__":
    main()
