"""Refit the DPUs' cost model and write what comes out: `python docs/make/cost_model.py`. A test keeps both fresh.

Writes [cost] of every board with published rates under profiles/targets, then docs/explanation/cost-model.md.
"""

import math
import re
import sys
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np

from deploy.dpu.board import load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.constants import LARGE_MAP_BYTES, NAMES, UNITS, Constants
from deploy.dpu.cost.fit import fit
from deploy.dpu.cost.latency import WIDTHS, paper_frames, predict
from deploy.dpu.cost.published import boards, published_cases
from deploy.dpu.cost.validation import (
    CONFIDENCE,
    LeftOut,
    Nested,
    beyond,
    by_network,
    coverage,
    family_quantile,
    nested,
    rank_correlation,
    transferred,
)
from deploy.dpu.zoo.networks import convbeers, network

TARGETS = Path(__file__).parents[2] / "profiles" / "targets"
PAGE = Path(__file__).parents[1] / "explanation" / "cost-model.md"
PAPER_BOARD, PAPER_FPS, PAPER_S = "vck190", 7.2, 42
WORST = 8
CHOSEN = "the choice of least error on families left out: deploy/dpu/cost/validation.py"
STATUS = {"serial": "assumed"}
CHOICE = {"serial": "the middle of 0 to 1: the published rates do not tell"}
FITTED = "the published rates of {rows} networks and configurations, deploy/dpu/zoo/published.csv"


def main() -> None:
    """Write all files."""
    for board in boards():
        path = TARGETS / f"{board}.toml"
        path.write_text(with_cost(path.read_text(encoding="utf-8"), board), encoding="utf-8", newline="\n")
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
    sys.stdout.write(f"wrote [cost] of {', '.join(boards())}, and {PAGE}\n")


def with_cost(profile: str, board: str) -> str:
    """The profile's text with its [cost] fitted anew."""
    lines = ["[cost] # written by docs/make/cost_model.py; the formula: deploy/dpu/cost/layers.py and host.py"]
    lines += [
        f'{key} = {{ value = {value}, status = "{STATUS.get(key, "inferred")}", source = "{source}" }}'
        for key, (value, source) in cost_table(board).items()
    ]
    block = "\n".join(lines) + "\n"
    if re.search(r"^\[cost]", profile, re.MULTILINE):
        return re.sub(r"^\[cost].*?\n(?=\n|\Z)", lambda _: block, profile, flags=re.DOTALL | re.MULTILINE)
    return profile.rstrip("\n") + "\n\n" + block


def cost_table(board: str) -> dict[str, tuple[str, str]]:
    """Values and sources of a board's [cost]."""
    outcome = nested(board)
    cases = published_cases(board, outcome.structure)
    fitted = "fit to " + FITTED.format(rows=len(cases.rows))
    found = {key: (f"{value:.4g}", fitted) for key, value in asdict(fit(cases).rounded()).items()}
    found |= {key: (f"{value:g}", CHOICE.get(key, CHOSEN)) for key, value in asdict(outcome.structure).items()}
    families = len({row.family for row in outcome.rows})
    left_out = f"|ln(predicted / published)| that nine of ten families keep to, from {families}, each left out once"
    for kind, width in outcome.widths.by_regime.items():
        found[WIDTHS[kind]] = (f"{width:.3f}", f"{left_out}; {kind}")
    widest = max(outcome.widths.by_regime.values())
    far = max(widest, family_quantile(*beyond(cases)))
    found[WIDTHS["outside"]] = (
        f"{far:.3f}",
        "the widest, or the error of networks with the largest maps, predicted from those with a quarter",
    )
    for key, (low, high) in fitted_ranges(outcome).items():
        found[f"fitted_{key}"] = (f"[{low:.4g}, {high:.4g}]", "range of the fitted networks that the DPU bounds")
    return found


def fitted_ranges(outcome: Nested) -> dict[str, tuple[float, float]]:
    """Ranges of the networks that the DPU bounds: the others tell nothing of it."""
    bound = {row.network for row in outcome.rows if row.regime != "host"}
    cases = published_cases(outcome.board, outcome.structure).rows
    maps = [row.map_bytes for row in cases if row.network in bound]
    works = [operations(name) for name in bound]
    return {"map_bytes": (min(maps), max(maps)), "operations": (min(works), max(works))}


@cache
def operations(name: str) -> int:
    """Operations of one of the published networks."""
    return sum(op.operations for op in network(name).operations)


def page() -> str:
    """The page as Markdown."""
    parts = [head(), convbeers_section(), METHOD, constants_section(), accuracy_section(), transfer_section()]
    return "\n".join([*parts, families_section(), networks_section()])


def head() -> str:
    """What to conclude, with the shares of what was left out that the intervals held."""
    held, whole = np.transpose([coverage(nested(board).rows) for board in boards()])
    shares = {"held": f"{min(held):.0%} to {max(held):.0%}", "whole": f"{min(whole):.0%} to {max(whole):.0%}"}
    return HEAD.format(**{name: text.replace("%", " %") for name, text in shares.items()})


def constants_section() -> str:
    """What is fitted, by board."""
    fitted = {board: Constants.of(load_dpu(board)) for board in boards()}
    rows = [(f"`{name}`", UNITS[name], *(f"{getattr(c, name):.3g}" for c in fitted.values())) for name in NAMES]
    structures = {board: nested(board).structure for board in boards()}
    rows += [
        (f"`{name}`", STATUS.get(name, "chosen"), *(f"{getattr(s, name):g}" for s in structures.values()))
        for name in ("serial", "crowding", "bursts")
    ]
    return "## Constants\n\n" + table(("constant", "unit", *fitted), rows)


def accuracy_section() -> str:
    """Errors of what was left out, by board."""
    rows = []
    for board in boards():
        outcome = nested(board)
        off, (held, whole) = np.array(list(by_network(outcome.rows).values())), coverage(outcome.rows)
        cases = published_cases(board, outcome.structure)
        spearman = rank_correlation(cases, np.array([row.error for row in outcome.rows]))
        rows.append(
            (
                board,
                len(off),
                len({row.family for row in outcome.rows}),
                sum(len(row.rates) for row in outcome.rows),
                percent(float(np.median(off))),
                percent(float(off.mean())),
                percent(float(off.max())),
                f"{spearman:.3f}",
                percent(held),
                percent(whole),
            )
        )
    head = ("board", "networks", "families", "rates", "median", "mean", "largest", "Spearman", "rates inside")
    return ACCURACY + table((*head, "families wholly inside"), rows)


def transfer_section() -> str:
    """A board predicted with another's constants."""
    rows = []
    for target in ("zcu104", "kv260"):
        errors = transferred("zcu102", target)
        cases = published_cases(target, nested(target).structure)
        left = [LeftOut(c.network, c.family, "", "host", e, (e,), 0) for c, e in zip(cases.rows, errors, strict=True)]
        foreign, own = (np.array(list(by_network(found).values())) for found in (left, nested(target).rows))
        for name, off in (("the ZCU102's constants", foreign), ("its own", own)):
            rows.append((target, name, percent(float(np.median(off))), percent(float(off.mean()))))
    return TRANSFER + table(("board", "constants", "median", "mean"), rows)


def families_section() -> str:
    """Mean error of each family on each board, and the worst explained."""
    names = sorted({row.family for board in boards() for row in nested(board).rows})
    found = {name: [family_error(board, name) for board in boards()] for name in names}
    rows = [
        (name, *("" if e is None else f"{100 * math.expm1(e):+.0f} %" for e in errors))
        for name, errors in found.items()
    ]
    worst = sorted(names, key=lambda name: -max(abs(e) for e in found[name] if e is not None))[:WORST]
    reasons = "\n".join(f"- **{name}**: {WHY[name]}." for name in worst)
    return f"{FAMILIES}{table(('family', *boards()), rows)}\nThe worst, and what we think of them:\n\n{reasons}\n"


def family_error(board: str, family: str) -> float | None:
    """Mean ln(predicted / published) of a family that was left out."""
    errors = [row.error for row in nested(board).rows if row.family == family]
    return float(np.mean(errors)) if errors else None


def networks_section() -> str:
    """A line a network."""
    found: dict[str, dict[str, list[LeftOut]]] = {}
    for board in boards():
        for row in nested(board).rows:
            found.setdefault(row.network, {}).setdefault(board, []).append(row)
    rows = [
        (name, f"{operations(name) / 1e9:.3g}", *(signed(here.get(board, [])) for board in boards()))
        for name, here in found.items()
    ]
    return "\n## Networks\n\nError when the family is left out; h: bound by the host.\n\n" + table(
        ("network", "GOP", *boards()), rows
    )


def signed(rows: list[LeftOut]) -> str:
    """Least and most error, and whether the host sets the rate."""
    if not rows:
        return ""
    ends = sorted({f"{100 * math.expm1(row.error):+.0f}" for row in rows}, key=float)
    shown = f"{ends[0]} to {ends[-1]} %" if len(ends) > 1 else f"{ends[0]} %"
    return shown + (" h" if any(row.regime == "host" for row in rows) else "")


def convbeers_section() -> str:
    """The paper's network on every board, beside its published figure."""
    frames, rows, outside = paper_frames(13600, 9016, 640), [], ""
    for board in boards():
        names = load_dpu(board).target.configurations if board == PAPER_BOARD else [None]
        for name in names:
            dpu = load_dpu(board, name)
            p = predict(place(convbeers(), dpu), dpu)
            low, high = p.fps_interval
            seconds = f"{frames / high:.3g} to {frames / low:.3g} ({frames / p.fps:.3g})"
            holds = ("yes" if low <= PAPER_FPS <= high else "no") if board == PAPER_BOARD else ""
            bound = max(p.layers, key=lambda layer: layer.time_s).bound
            rows.append((board, dpu.name, f"{low:.3g} to {high:.3g} ({p.fps:.3g})", seconds, bound, holds))
            outside = "; ".join(p.outside)
    head = ("board", "configuration", "FPS, 640 x 640", "s for 13600 x 9016", "longest layer", f"holds {PAPER_FPS}")
    paper = f"| vck190 | paper, not named | {PAPER_FPS} (published) | {PAPER_S} (published) | | |\n"
    outside = f"Outside the fitted range: {outside}" if outside else "It lies inside the fitted range"
    return CONVBEERS.format(paper=PAPER_FPS, outside=outside) + table(head, rows) + paper


def percent(share: float) -> str:
    """A share as percent, three digits at most."""
    return f"{100 * share:.1f} %" if share < 0.2 else f"{100 * share:.0f} %"


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    lines = [list(map(str, head)), *(list(map(str, row)) for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


WHY = {
    "ssd fpn": "its host sorts 4.9 million scores and gains nothing from more threads (published: 12 frames a second "
    "whatever the DPU); the model spreads that over the host's cores",
    "multi-task": "its host reads a map of pixels and ranks boxes of several heads: one label stands for both",
    "sesr": "16 features: the board moves its maps faster than the fit believes of wider ones",
    "ssd mobile": "the VEK280's rates are those of its host, which ranks boxes faster than in other networks",
    "superpoint": "its host takes the softmax of some results and copies others: one label stands for both",
    "ssd": "its host takes a softmax of 1.5 million scores; on large Versal DPUs that is most of the time",
    "densebox": "too fast on three Zynq boards alike: perhaps a slower network or a busier host was timed there",
    "squeezenet": "so light that what the host does for any image sets the rate, which the VEK280 does faster for it",
    "mobilenet v1": "27 MOP in the smallest: times of an image that no count of bytes or operations holds bound it",
    "mobilenet v2": "widened maps lie just above what a group of banks holds and count as passing through memory",
    "efficientnet": "widened maps lie just above what a group of banks holds and count as passing through memory",
    "csp": "light ones are bound by a host that reads 25 200 boxes; how much of each is not published",
    "face quality": "61 MOP: starts of layers are most of its time",
    "rcan": "moves more than we count: the file that was timed may hold its attention layers",
    "unet": "small maps and many transposed convolutions; its host paints cells, which no label tells",
    "retinaface": "its host ranks boxes of three heads and their landmarks: one label stands for both",
    "vgg": "four fifths of its bytes are weights of three layers, which stream faster than other transfers",
    "sphereface": "its weights, twenty times its maps, stream faster than other transfers",
    "mobilenet edge": "its fused blocks run slower than their layers one by one",
    "resnet": "the one with the most rates: what the others tell of it is little",
}
"""Of families; a new one among the WORST wants a reason of its own."""

HEAD = """# The cost model of the DPUs

Generated by `python docs/make/cost_model.py`, which also writes [cost] of every board under `profiles/targets`.

What to conclude:

- Take the interval, not the number in the middle. Of the published rates of families that the fit had not seen,
  {held} lay inside theirs, by board; of whole families, with every rate of every network, {whole}.
- The order of networks and configurations is right nearly always (Spearman's correlation below), so choices between
  them are safer than any one figure.
- Where the host sets the rate, a faster DPU buys nothing, and the model knows the host by five labels alone: measure
  such a network on the board, and give the run to `bench --measured`.
- No figure here is a measurement of ours: the rates are AMD's, end to end with the host's work.
"""

CONVBEERS = """## ConvBEERS, 16 blocks of 64 features, 640 x 640

Nothing of it is in any fit, nor is the paper's {paper} FPS. {outside}. First the interval, then the middle.

"""

METHOD = """
## Formula

    compute = array operations / (peak array_efficiency) + lane steps / (lanes lane_efficiency)
    memory  = longer of (weights + maps) / port and cores (weights / BW + handlers maps / (DDR memory_efficiency))
    layer   = longer of the two + serial shorter of the two + layer_s
    DPU     = (sum of layers + batch_s) / images in flight
    host    = (host_image_s + bytes in / rate + bytes out / rate + values / the task's rate) / host's cores
    FPS     = 1 / (DPU^crowding + host^crowding)^(1 / crowding)

One formula for three kinds of DPU: `cores` load their own weights and share the DDR; batch handlers of a core share
the weights too. BW is the DDR's peak where weights cross it in `bursts`, else the rate of maps. Peak, lanes, clocks
and DDR are the board's, in its file; what is fitted is shares of them and times. With one thread DPU and host take
turns, 1 / (one core's DPU + host); such rates are fitted beside.

What is counted, from shapes alone (`deploy/dpu/cost/work.py`): input channels, output channels, rows and, on Versal,
columns filled up to the array's; layers of fewer input channels than it takes gather their window's columns;
transposed convolutions run over the zeros between their pixels. Pools and depthwise convolutions run on the ALU, adds
on the element-wise engine. A result passes through memory where a group of feature-map banks cannot hold it, where
more than two operations read it, or where a concat joins it. An add reads no operand that its own convolution has
read, a pixel shuffle is no more than where results go.

The host's tasks (`deploy/dpu/cost/host.py`): copy, argmax, softmax, sort (boxes, key points) and image, the same in
the fit and for a file, where the operators behind the last convolution tell.

Least squares on ln(FPS) with a soft L1 loss over `deploy/dpu/zoo/published.csv`; every network weighs the same,
however many rates it has. `crowding` and `bursts` are chosen by cross-validation; `serial` is assumed: the rates do
not tell how much is hidden.

"""

ACCURACY = f"""
## How far off

Nested: each family is left out in turn; structure, constants and the width of its intervals come from the others
alone. Errors are means over a network's rates; a network counts once. Intervals have three widths, by what sets the
rate: the host, small maps (up to {LARGE_MAP_BYTES >> 20} MiB), large maps. A family's score is its largest error, of
any one rate, over the typical one of the regime; the width is the typical error times the score that nine of ten
families keep to, at {100 * CONFIDENCE:.0f} % confidence (of thirty families the last but one, of fourteen the last).

What nesting does not cover, so that errors here are somewhat too kind: what the formula counts, the variants offered
to the choice, that it is one for all boards, the starts of the fit and some labels of the host were settled while
looking at these same networks, some after seeing such a table. A fit without a family begins near the fit
of all. Networks that nobody here has looked at are the better judge.

"""

TRANSFER = """
## A board from another's constants

Fitted to the ZCU102's rates without the family that is predicted; cores, clock and memory from the board's file, no
rate of the board itself. Then with its own.

"""

FAMILIES = """
## Families

Mean error of a family, left out; + is too fast.

"""

if __name__ == "__main__":
    main()
