"""Refit the DPU's cost model and write what comes out: `python docs/make_cost_model.py`. A test keeps both fresh.

Writes the constants into [cost] of profiles/targets/vck190.toml, then docs/cost-model.md.
"""

import math
import re
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from deploy.dpu.board import load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.fit import Cases, fit
from deploy.dpu.cost.latency import Prediction, paper_frames, predict
from deploy.dpu.cost.layers import Constants
from deploy.dpu.cost.validation import (
    beyond,
    bound_by_dpu,
    coverage,
    fitted_ranges,
    leave_out,
    published_cases,
    quantile,
    rank_correlation,
    relative,
)
from deploy.dpu.zoo.networks import convbeers

PROFILE = Path(__file__).parents[1] / "profiles" / "targets" / "vck190.toml"
PAGE = Path(__file__).parent / "cost-model.md"
PAPER_FPS, PAPER_S = 7.2, 42
WORST = 6

MEANING = {
    "efficiency": ("share of the array's peak that a full layer reaches", 1, ""),
    "map_bytes_per_s": ("feature maps between the DPU and memory", 1e-9, "GB/s"),
    "batch_s": ("start of a batch", 1e6, "us"),
    "layer_s": ("start of a layer", 1e6, "us"),
    "host_in_bytes_per_s": ("the host makes the image ready", 1e-6, "MB/s"),
    "host_out_bytes_per_s": ("the host reads results", 1e-6, "MB/s"),
}

WHY = {
    "yolo v5 n": "so light that the model lets its host bound it; how much of 25 200 boxes that host reads is not "
    "published",
    "mobilenet v1 0.25": "27 MOP: times of an image that no count of bytes or operations holds bound it",
    "yolo v3 512 x 288": "published no faster than 416 x 416, for 15 % fewer operations",
    "efficientnet lite0": "its widened maps lie just above 1 MiB and count as passing through memory; the board "
    "seems to keep them",
    "inception-resnet v2": "its residual sums feed three branches and an add each, and count as passing through "
    "memory; the board seems to keep some",
    "yolo v2": "published at 14.7 TOPS, more than any other row on C32B3",
}
"""Of the WORST networks; a new one among them wants a reason of its own."""


def main() -> None:
    """Write both files."""
    cases = published_cases()
    PROFILE.write_text(with_cost(PROFILE.read_text(encoding="utf-8"), cases), encoding="utf-8", newline="\n")
    PAGE.write_text(page(cases), encoding="utf-8", newline="\n")
    sys.stdout.write(f"wrote {PROFILE} and {PAGE}\n")


def with_cost(profile: str, cases: Cases) -> str:
    """The profile's text with its [cost] fitted anew."""
    names = [row.network for row in cases.rows]
    constants = fit(cases).rounded()
    source = f"fit on {len(names)} published rates of {len(set(names))} networks, deploy/dpu/zoo/published.csv"
    values: dict[str, tuple[object, str]] = {key: (f"{v:.4g}", source) for key, v in asdict(constants).items()}
    left_out = f"each of the {len(set(names))} networks left out of the fit once"
    inside = quantile(leave_out(cases, names), names)
    values["error_inside"] = (f"{inside:.3f}", f"90 % quantile of |ln(predicted / published)|, {left_out}")
    errors, tested = beyond(cases)
    outside = max(inside, quantile(errors, tested))
    why = (
        f"the same of {len(set(tested))} networks with large maps, predicted from those with maps at most a quarter "
        "of the largest"
    )
    values["error_outside"] = (f"{outside:.3f}", why)
    for key, (low, high) in fitted_ranges(cases, constants).items():
        values[f"fitted_{key}"] = (f"[{low:.4g}, {high:.4g}]", "range of the fitted networks that the DPU bounds")
    lines = ["[cost] # written by docs/make_cost_model.py; the formula: deploy/dpu/cost/layers.py", SERIAL]
    lines += [f'{key} = {{ value = {v}, status = "inferred", source = "{s}" }}' for key, (v, s) in values.items()]
    return re.sub(r"\[cost\].*?(?=\n\[power\])", lambda _: "\n".join(lines) + "\n", profile, flags=re.DOTALL)


SERIAL = (
    'serial = { value = 0.5, status = "assumed", source = '
    '"the middle of 0 to 1: the fit on published rates is as good from 0.25 to 1" }'
)


def page(cases: Cases) -> str:
    """The page as Markdown."""
    names = [row.network for row in cases.rows]
    constants = Constants.of(load_dpu("vck190"))
    errors = leave_out(cases, names)
    parts = [HEAD, constants_section(constants), accuracy_section(cases, errors), networks_section(cases, errors)]
    return "\n".join([*parts, not_fitted_section(constants), convbeers_section()])


def constants_section(constants: Constants) -> str:
    """What is fitted, and what is not."""
    dpu = load_dpu("vck190")
    rows = [
        (f"`{key}`", meaning, f"{value * scale:.3g} {unit}".strip(), "fitted")
        for (key, value), (meaning, scale, unit) in zip(asdict(constants).items(), MEANING.values(), strict=True)
    ]
    rows.append(
        (
            "`serial`",
            "share of the shorter of compute and memory that is not hidden",
            f"{dpu.value('cost', 'serial'):g}",
            "assumed",
        )
    )
    rows.append(
        ("P", "peak of one batch handler's array (C32)", f"{dpu.engine_ops_per_s / 1e12:.2f} TOPS", "specification")
    )
    rows.append(("R", "ALU and element-wise engine", f"{dpu.lane_steps_per_s / 1e9:.3g} G values/s", "specification"))
    rows.append(
        (
            "BW",
            "peak of the memory, for weights",
            f"{dpu.value('memory', 'ddr_bytes_per_s') / 1e9:g} GB/s",
            "specification",
        )
    )
    return "## Constants\n\n" + table(("constant", "what it is", "value", "from"), rows)


def accuracy_section(cases: Cases, errors: np.ndarray) -> str:
    """Errors of what was left out, by network and by family."""
    families = [row.family for row in cases.rows]
    names = [row.network for row in cases.rows]
    sorting = published_cases(sorting=True)
    rest = sorting.errors(fit(cases))
    both = Cases(cases.rows + sorting.rows, cases.serial)
    variants = {
        f"one of {len(set(names))} networks": (cases, errors, names),
        f"one of {len(set(families))} families": (cases, leave_out(cases, families), families),
        "one network, and those below that were never fitted": (
            both,
            np.concatenate([errors, rest]),
            [*names, *(row.network for row in sorting.rows)],
        ),
    }
    rows = [
        (
            name,
            len(left),
            f"{100 * np.median(relative(left)):.1f} %",
            f"{100 * relative(left).mean():.1f} %",
            f"{100 * relative(left).max():.0f} %",
            f"{rank_correlation(which, left):.3f}",
            f"{100 * coverage(left, groups):.0f} %",
        )
        for name, (which, left, groups) in variants.items()
    ]
    head = ("left out", "rows", "median", "mean", "largest", "Spearman", "90 % interval covers")
    far, tested = beyond(cases)
    text = (
        f"\nFrom small maps to large ones: {len(set(tested))} networks with maps up to four times as large as any "
        f"that the DPU bounds in the fit are off by {100 * np.median(relative(far)):.0f} % in the median and "
        f"{100 * relative(far).mean():.0f} % in the mean.\n"
    )
    return (
        "\n## How far off\n\nError of frames a second, predicted without what is left out:\n\n"
        + table(head, rows)
        + text
    )


def networks_section(cases: Cases, errors: np.ndarray) -> str:
    """A line a network, and the worst explained."""
    names = np.array([row.network for row in cases.rows])
    bound = bound_by_dpu(cases, fit(cases))
    rows, mean = [], {}
    for name in dict.fromkeys(names.tolist()):
        mine = names == name
        row = cases.only(mine).rows[0]
        off = 100 * np.expm1(errors[mine])
        mean[name] = float(relative(errors[mine]).mean())
        rates = [r.fps for r in cases.only(mine).rows]
        boards = sorted({r.configuration for r in cases.only(mine).rows})
        shown = f"{off.min():+.0f} %" if len(off) == 1 else f"{off.min():+.0f} to {off.max():+.0f} %"
        host = "DPU" if bound[mine].all() else "host" if not bound[mine].any() else "either"
        work, largest = f"{row.profile.operations / 1e9:.3g}", f"{row.profile.map_bytes / 1e6:.2g}"
        rows.append(
            (
                name,
                work,
                largest,
                f"{boards[0]} to {boards[-1]}" if len(boards) > 1 else boards[0],
                len(off),
                f"{min(rates):.4g} to {max(rates):.4g}" if len(rates) > 1 else f"{rates[0]:.4g}",
                host,
                shown,
            )
        )
    head = (
        "network",
        "GOP",
        "largest map MB",
        "configurations",
        "rows",
        "published FPS",
        "bound by",
        "error when left out",
    )
    worst = sorted(mean, key=lambda name: -mean[name])[:WORST]
    reasons = "\n".join(f"- **{name}** ({100 * mean[name]:.0f} %): {WHY[name]}." for name in worst)
    return f"\n## Networks\n\n{table(head, rows)}\nThe worst, and what we think of them:\n\n{reasons}\n"


def not_fitted_section(constants: Constants) -> str:
    """The rows whose host does what the model cannot count."""
    cases = published_cases(sorting=True)
    errors = cases.errors(constants)
    rows = [
        (r.network, r.configuration, f"{r.fps:g}", f"{r.fps * math.exp(e):.0f}", f"{100 * math.expm1(e):+.0f} %")
        for r, e in zip(cases.rows, errors, strict=True)
    ]
    return NOT_FITTED + table(("network", "configuration", "published FPS", "predicted", "off by"), rows)


def convbeers_section() -> str:
    """The paper's network for each configuration, beside its published figure."""
    frames, rows, outside = paper_frames(13600, 9016, 640), [], ""
    for name in load_dpu("vck190").target.configurations:
        dpu = load_dpu("vck190", name)
        p: Prediction = predict(place(convbeers(), dpu), dpu)
        low, high = p.fps_interval
        holds = "yes" if low <= PAPER_FPS <= high else "no"
        bound = max(p.layers, key=lambda layer: layer.time_s).bound
        rows.append(
            (
                name,
                f"{p.fps:.3g} [{low:.3g}, {high:.3g}]",
                f"{frames / p.fps:.3g} [{frames / high:.3g}, {frames / low:.3g}]",
                bound,
                holds,
            )
        )
        outside = "; ".join(p.outside)
    head = (
        "configuration",
        "FPS, 640 x 640",
        "s for 13600 x 9016",
        "longest layer bound by",
        f"holds the published {PAPER_FPS}",
    )
    return (
        CONVBEERS.format(outside=outside)
        + table(head, rows)
        + f"| paper, configuration not named | {PAPER_FPS} (published) | {PAPER_S} (published) | | |\n"
    )


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    lines = [list(map(str, head)), *(list(map(str, row)) for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


HEAD = f"""# The cost model of the DPU

Generated by `python docs/make_cost_model.py`, which also writes the constants into `profiles/targets/vck190.toml`.

    compute = array operations / (P efficiency) + lane steps / R
    memory  = weights / BW + batch maps / map_bytes_per_s
    layer   = longer of the two + serial shorter of the two + layer_s
    batch   = sum of layers + batch_s
    host    = bytes in / host_in_bytes_per_s + bytes out / host_out_bytes_per_s
    FPS     = 1 / max(batch time / batch, host)

What is counted, from shapes alone (`deploy/dpu/cost/layers.py`): the array computes 16 input by 32 (C64: 64) output
channels by 8 pixels, used or not; layers of fewer than 16 input channels gather their window's columns. Pools and
depthwise convolutions run on the ALU engine, adds on the element-wise one, 16 channels by 8 pixels a cycle at 333
MHz; activations are fused. A result passes through memory where it is larger than 1 MiB, where more than two
operations read it, or where a concat joins it. Weights are loaded once a batch.

The fit is least squares on ln(FPS) with a soft L1 loss over `deploy/dpu/zoo/published.csv`, the published rates with
several threads: they hide the host behind the DPU until the host itself is the slower. The networks are written down
from their papers, without weights; their operations agree with the published ones within 4 % (a test). The paper's
{PAPER_FPS} FPS is in no fit.

Which results pass through memory, and that a depthwise layer's multiplier repeats its pass, was read off the
residuals of these same networks, as were `serial` and a host with rates of its own: errors when left out are that
much too kind. What a published network's
rate contains (threads, release, host code) is not always stated.
"""

NOT_FITTED = """
## Published, and not fitted

Their hosts sort boxes or key points of dense maps (SSD, SuperPoint): time that no count of bytes tells. The published
SSD gains nothing from twice the engines. The model is too fast for them:

"""

CONVBEERS = """
## ConvBEERS, 16 blocks of 64 features, 640 x 640

Outside the fitted range: {outside}. The interval is the wide one, from nothing hidden to everything hidden, and the
error of networks with large maps on top of it. Treat the interval as the figure.

"""

if __name__ == "__main__":
    main()
