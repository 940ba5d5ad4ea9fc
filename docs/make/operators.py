"""Write docs/reference/operators.md from the DPUs' rules themselves: `python
docs/make/operators.py`.

A test keeps it fresh.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

from beers_deploy.dpu.board import Dpu, device_of, load_dpu
from beers_deploy.dpu.checker.finding import Rule
from beers_deploy.dpu.checker.operators import (
    NUMBERS,
    RULES,
    SHIFTS,
    SIZES,
    all_rules,
    applies,
    rule_name,
    rule_text,
)
from beers_deploy.dpu.checker.remarks import REMARKS
from beers_deploy.dpu.graph import KINDS, Kind
from beers_deploy.profiles.shipped import board_names, npu_names
from beers_deploy.profiles.target import TargetProfile

TARGET = Path(__file__).parents[1] / "reference" / "operators.md"
DPUS = {name: load_dpu(name) for name in board_names()}
SPELT: dict[Kind, tuple[str, ...]] = {
    "depthwise": ("Conv and QLinearConv with a group for every channel",),
    "activation": ("Clip from 0 to 6", "Max with the zero point"),
    "other": ("every operator not named here",),
}
"""Conditions of a kind in addition to the operator's name."""

OPENING = """# Operators of the DPUs

    beers-deploy check network.onnx --target zcu102

applies these rules to your network; `beers-deploy profiles NAME` lists the limits of a board with their sources. A
rule applies to all boards or to those named with it; parentheses have what differs on the boards named there. Limits
are those of each board's default configuration; a smaller one has lower limits on channels.

A node runs on the DPU if it keeps every rule of its kind, the rules of size, and in a quantised file those of numbers. A
fully connected layer, or a convolution as large as its map, is also judged as a 1 x 1 convolution over the flattened
map. Other nodes run on the board's processor: `check` fails and names what to use instead of the operator; `bench`
counts their time at the start and the end of a float network, and refuses the network elsewhere.
"""
VARYING = re.compile(r"((?<=: )[^.:]+(?=\.)|\d+)")
"""The parts of a rule's text that may differ between boards.

They are a list up to the end of a sentence, or a number.
"""


def document() -> str:
    """Return the page as Markdown."""
    parts = [OPENING, *_kinds()]
    parts += _rules("Sizes, for every node", SIZES)
    parts += _rules(
        "Numbers, in a quantised file",
        [*NUMBERS, *dict.fromkeys(chain.from_iterable(SHIFTS.values()))],
    )
    parts += _rules("Remarks, which break no rule", REMARKS)
    for name in npu_names():
        parts += _npu(device_of(TargetProfile.load(name)))
    return "\n".join(parts)


def _kinds() -> Iterator[str]:
    """Yield one section for the kinds that share their rules."""
    kinds: dict[tuple[Rule, ...], list[Kind]] = {}
    for kind, rules in RULES.items():
        kinds.setdefault(rules, []).append(kind)
    for rules, group in kinds.items():
        names = [name for name, kind in KINDS.items() if kind in group]
        for kind in group:
            names += SPELT.get(kind, ())
        yield from _rules(f"{', '.join(group)}: {', '.join(names)}", rules)


def _rules(title: str, rules: Iterable[Callable[..., object]]) -> list[str]:
    """Return a line for each rule, and for each wording if boards differ in more than a list."""
    lines = list(chain.from_iterable(map(_lines, rules)))
    return [f"## {title}\n", *(lines or ["Runs on every DPU."]), ""]


def _npu(npu: Dpu) -> Iterator[str]:
    """Yield the rules of a board with an NPU: AMD's table of operators, and the numbers of a VINT8
    file.
    """
    texts = {
        rule_name(rule): (rule, rule_text(rule, npu)) for rule in all_rules() if applies(rule, npu)
    }
    same = [
        name
        for name, (rule, text) in texts.items()
        if _without_sources(text, npu) in _texts(rule).values()
    ]
    yield f"## The NPU of {npu.target.name}: a table of operators, and numbers alone\n"
    yield (
        "AMD publishes no limits; numbers are its quantiser's. [The NPU's flow](npu.md) has "
        "what else is known."
    )
    yield f"As for the DPUs: {', '.join(same)}. What differs ({npu.target.documents['quantiser']}):\n"
    above = f" ({npu.target.documents['quantiser']})"
    for name, (rule, text) in texts.items():
        if name not in same:
            yield f"- **{name}**: {_own_sentences(rule, text.replace(above, ''))}"
    yield ""


def _own_sentences(rule: Callable[..., object], text: str) -> str:
    """Return the sentences of a rule's text on an NPU that it has on no DPU."""
    others = _texts(rule).values()
    sentences = re.split(r"(?<=\.) ", text)
    return " ".join(s for s in sentences if not any(s in other for other in others))


def _texts(rule: Callable[..., object]) -> dict[str, str]:
    """Return the text of a rule on each board with a DPU to which it applies."""
    return {
        name: _without_sources(rule_text(rule, dpu), dpu)
        for name, dpu in DPUS.items()
        if applies(rule, dpu)
    }


def _lines(rule: Callable[..., object]) -> Iterator[str]:
    texts = _texts(rule)
    if len({VARYING.sub("", text) for text in texts.values()}) == 1:
        texts = dict.fromkeys(texts, _with_each_part(texts))
    for names, text in _alike(texts):
        where = "" if names == "all" else f" on {names}"
        yield f"- **{rule_name(rule)}**{where}: {text}"


def _with_each_part(texts: Mapping[str, str]) -> str:
    """Return one text for boards that differ in numbers or lists: "at most 4096 (vek280: 8192)"."""
    parts = zip(*map(VARYING.split, texts.values()), strict=True)
    return "".join(_each(dict(zip(texts, part, strict=True))) for part in parts)


def _each(values: Mapping[str, str]) -> str:
    most = max(values.values(), key=[*values.values()].count)
    rest = _alike({name: value for name, value in values.items() if value != most})
    others = "; ".join(f"{names}: {value}" for names, value in rest)
    return f"{most} ({others})" if others else most


def _without_sources(text: str, dpu: Dpu) -> str:
    """Return the text of a rule without its sources, in which boards with one limit differ."""
    sources = set[str]()
    tables: list[Mapping[str, object]] = [*dpu.tables.values(), dpu.target.activations]
    for facts in tables:
        sources |= {str(getattr(fact, "source", "")) for fact in facts.values()}
    for source in sorted(sources | {*dpu.target.documents.values()}, key=len, reverse=True):
        text = re.sub(rf" \({re.escape(source)}[^()]*\)", "", text) if source else text
    return text


def _alike(texts: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the boards of each different text, and the text."""
    boards: dict[str, list[str]] = {}
    for name, text in texts.items():
        boards.setdefault(text, []).append(name)
    for text, names in boards.items():
        yield "all" if len(names) == len(DPUS) else ", ".join(names), text


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8", newline="\n")
    print(f"wrote {TARGET}")
