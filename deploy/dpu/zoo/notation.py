"""Networks as text: the notation of the `.net` files in this folder, and its reader.

    block basic c                          # a block has parameters, some with defaults: block down c s=2
        conv c | conv c | add x            # a line is steps, each reading the result of the step before

    network small
        family resnet                      # networks of one family resemble one another
        host   argmax                      # what the host does with the results: copy argmax softmax sort image
        gop    1.2                         # published operations (two a product), in 10^9
        source He et al. 2015, table 1     # where the layers are written
        image  224 224                     # height, width, and channels if not 3
        conv 64 7 2 | pool 3 2
        y = basic 64 *2                    # twice; the result is kept as y, and x stays what it was
        conv 64 1 | add y                  # this result is x, where the next line starts
        y | conv 32 | out                  # a line may start from a kept result
        global | fc 1000

`x` is where a line starts: the result of the last line without a name. `ch` is its number of channels. A number may
be a sum, difference, product or exact quotient of numbers, parameters and `ch`, without spaces: `4*c`, `ch/2`. A size
is one number or HEIGHTxWIDTH: `1x7`. A parameter of a block may also stand for a kept result. In a block, x is what
the block was called on, and its last x is what it returns.

    conv C [K=3 [S=1]] [d=1] [g=1] [valid]    convolution into C channels, kernel, stride, dilation, groups
    dw [K=3 [S=1]] [d=1] [m=1]                depthwise, into m times the channels
    transposed C K S                          transposed convolution, S times as large
    fc C                                      fully connected
    pool K S [valid|ceil]                     largest of a window
    mean K S [valid|ceil]                     mean of a window
    global                                    mean of each channel
    scale                                     batch norm that no convolution can take in
    resize [N=2|NAME]                         N times as large, or as a kept result: nearest neighbour
    bilinear [N=2|NAME]                       the same, bilinear
    shuffle [N=2]    unshuffle [N=2]          channels to N x N pixels and back
    add NAME...      concat NAME...           joins the result so far with kept ones
    mul NAME                                  the same, a product
    slice FIRST COUNT                         some of the channels
    hsigmoid         hswish                   an activation that is a step of its own
    out [CHANNELS]                            a result of the network, of which the host reads so many channels

Sizes are divided by a stride and rounded up, unless `valid` (no padding) or `ceil` (no padding before an image, as
much as needed behind it). A network without `out` has one result, its last x, read whole. Batch norms and activations
behind a convolution are fused into it and not written. Every file knows the blocks of all files.
"""

import ast
import inspect
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NoReturn, get_args

from deploy.dpu.zoo.builder import Builder, Size, Tensor, Written
from profiles.errors import ModelError

Host = Literal["copy", "argmax", "softmax", "sort", "image"]
"""What the host does with the results."""

Value = Tensor | Size

STEPS: Mapping[str, Callable[..., Tensor]] = {
    "conv": Builder.conv,
    "dw": Builder.depthwise,
    "transposed": Builder.transposed,
    "fc": Builder.full,
    "pool": Builder.pool,
    "mean": Builder.mean,
    "global": Builder.global_mean,
    "scale": Builder.scale,
    "resize": Builder.resize,
    "bilinear": Builder.bilinear,
    "shuffle": Builder.shuffle,
    "unshuffle": Builder.unshuffle,
    "add": Builder.add,
    "mul": Builder.mul,
    "concat": Builder.concat,
    "slice": Builder.slice,
    "hsigmoid": lambda builder, x: builder.activation(x, "HardSigmoid"),
    "hswish": lambda builder, x: builder.activation(x, "HardSwish"),
    "out": Builder.out,
}
FLAGS = ("valid", "ceil")
JOINS, RESIZES = ("add", "mul", "concat"), ("resize", "bilinear")
"""Steps that take kept results alone, and those that may take one."""
SIGNS: Mapping[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.floordiv,
}
DEEPEST, LARGEST = 20, 1 << 20
"""Blocks within blocks; numbers."""


@dataclass(frozen=True)
class Line:
    """A line without its comment, and its place: "file, line 12"."""

    where: str
    text: str


@dataclass
class Block:
    """Lines under a name; parameters with the text of their defaults."""

    parameters: Mapping[str, str | None]
    lines: list[Line] = field(default_factory=list)


@dataclass
class Entry:
    """A network of a file."""

    where: str
    header: dict[str, str] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)

    @property
    def family(self) -> str:
        """Networks of one family resemble one another."""
        return self.header["family"]

    @property
    def host(self) -> Host:
        """What the host does with the results."""
        found: Host = next(host for host in get_args(Host) if host == self.header["host"])
        return found

    @property
    def operations(self) -> float:
        """Published operations for one image, two a product."""
        return 1e9 * float(self.header["gop"])

    @property
    def source(self) -> str:
        """Where the layers are written."""
        return self.header["source"]


HEADER = ("family", "host", "gop", "source", "image")


@dataclass(frozen=True)
class Library:
    """The blocks and networks of some files."""

    blocks: Mapping[str, Block]
    networks: Mapping[str, Entry]

    def write(self, name: str) -> Written:
        """One network, layer by layer.

        Raises:
            ModelError: a line that cannot be understood, or shapes that do not fit; it names file and line.
        """
        entry = self.networks[name]
        scope = _Scope(self.blocks, _image(entry), {})
        for line in entry.lines:
            scope.run(line)
        return scope.builder.written(scope.x)


def read_library(paths: Sequence[Path]) -> Library:
    """The blocks and networks of `.net` files.

    Raises:
        ModelError: a line outside a block or network, a name given twice, an incomplete header; names file and line.
    """
    blocks: dict[str, Block] = {}
    networks: dict[str, Entry] = {}
    open_lines: list[Line] | None = None
    for line, indented in (pair for path in paths for pair in _lines(path)):
        if not indented:
            open_lines = _open(line, blocks, networks)
        elif open_lines is None:
            _refuse(line.where, "block or network before the first indented line", line.text, "add one")
        else:
            open_lines.append(line)
    for entry in networks.values():
        _take_header(entry)
    return Library(blocks, networks)


def _lines(path: Path) -> list[tuple[Line, bool]]:
    """Lines that are not empty, and whether they are indented."""
    texts = (text.partition("#")[0].rstrip() for text in path.read_text(encoding="utf-8").splitlines())
    return [
        (Line(f"{path.name}, line {number}", text.strip()), text[0].isspace())
        for number, text in enumerate(texts, 1)
        if text
    ]


def _open(line: Line, blocks: dict[str, Block], networks: dict[str, Entry]) -> list[Line]:
    """Where the lines behind a `block` or `network` go."""
    kind, _, rest = line.text.partition(" ")
    name, *parameters = rest.split() if kind == "block" else [rest.strip()]
    if kind not in ("block", "network") or not name:
        _refuse(line.where, "block NAME PARAMETER... or network NAME", line.text, "indent steps, or correct the word")
    if name in (blocks if kind == "block" else networks) or name in STEPS:
        _refuse(line.where, f"a new name for a {kind}", name, "choose another")
    if kind == "network":
        networks[name] = entry = Entry(line.where)
        return entry.lines
    pairs = (parameter.partition("=") for parameter in parameters)
    blocks[name] = block = Block({key: default or None for key, _, default in pairs})
    return block.lines


def _take_header(entry: Entry) -> None:
    """Move the first lines of a network into its header."""
    while entry.lines and entry.lines[0].text.split()[0] in HEADER:
        key, _, value = entry.lines.pop(0).text.partition(" ")
        entry.header[key] = value.strip()
    if missing := [key for key in HEADER if not entry.header.get(key)]:
        _refuse(entry.where, f"lines {', '.join(HEADER)} first", f"no {missing[0]}", "add it")
    if entry.header["host"] not in get_args(Host):
        _refuse(entry.where, f"host one of {', '.join(get_args(Host))}", entry.header["host"], "choose one")
    if not re.fullmatch(r"\d+(\.\d+)?", entry.header["gop"]):
        _refuse(entry.where, "gop and a number", entry.header["gop"], "write it as 3.65")


def _image(entry: Entry) -> Builder:
    words = entry.header["image"].split()
    if len(words) not in (2, 3) or not all(word.isdigit() and 0 < int(word) <= LARGEST for word in words):
        _refuse(entry.where, "image HEIGHT WIDTH [CHANNELS]", entry.header["image"], "write it as 224 224")
    return Builder(*map(int, words))


class _Scope:
    """A network or a block while its lines are read."""

    def __init__(
        self, blocks: Mapping[str, Block], builder: Builder, names: dict[str, Value], depth: int = 0
    ) -> None:
        self.blocks, self.builder, self.depth = blocks, builder, depth
        self.names: dict[str, Value] = {"x": builder.image, **names}

    @property
    def x(self) -> Tensor:
        """Where a line starts."""
        found = self.names["x"]
        assert isinstance(found, Tensor)  # noqa: S101 - x is kept by `run` alone
        return found

    def run(self, line: Line) -> None:
        """Take all steps of a line."""
        kept = re.match(r"(\w+) = ", line.text)
        self.builder.where, self.names["ch"] = line.where, self.x.channels
        result = self.x
        for step in line.text[kept.end() if kept else 0 :].split("|"):
            result = self._step(result, step.split(), line.where)
            self.builder.where = line.where
        self.names[kept[1] if kept else "x"] = result

    def _step(self, x: Tensor, words: list[str], where: str) -> Tensor:
        if not words:
            _refuse(where, "a step between bars", "none", "remove a bar")
        times = self._number(words.pop()[1:], where) if words[-1].startswith("*") else 1
        if len(words) == 1 and isinstance(kept := self.names.get(words[0]), Tensor):
            return kept
        for _ in range(times):
            x = self._call(x, words[0], words[1:], where)
        return x

    def _call(self, x: Tensor, word: str, arguments: list[str], where: str) -> Tensor:
        if word in STEPS:
            return self._append(x, word, arguments, where)
        if word not in self.blocks:
            _refuse(where, "a step, a block or a kept result", word, "correct the word, or write the block")
        if self.depth == DEEPEST:
            _refuse(where, f"at most {DEEPEST} blocks within one another", word, "break the circle")
        block = self.blocks[word]
        given = dict(zip(block.parameters, arguments, strict=False))
        texts = {key: given.get(key, default) for key, default in block.parameters.items()}
        if len(arguments) > len(texts) or None in texts.values():
            _refuse(where, " ".join([word, *block.parameters]), " ".join([word, *arguments]), "give each one value")
        names = {key: self._value(text or "", where) for key, text in texts.items()}
        scope = _Scope(self.blocks, self.builder, {**names, "x": x}, self.depth + 1)
        for line in block.lines:
            scope.run(line)
        return scope.x

    def _append(self, x: Tensor, word: str, arguments: list[str], where: str) -> Tensor:
        options = [text.partition("=") for text in arguments if "=" in text or text in FLAGS]
        named = {key: self._number(text or "1", where) for key, _, text in options}
        values = [self._value(text, where) for text in arguments if "=" not in text and text not in FLAGS]
        if word not in ("slice", "out") and any(_has_zero(value) for value in [*values, *named.values()]):
            _refuse(where, f"{word} with numbers of 1 and more", " ".join([word, *arguments]), "correct the zero")
        step = STEPS[word]
        kept = [isinstance(value, Tensor) for value in values]
        fits = all(kept) and bool(kept) if word in JOINS else word in RESIZES or not any(kept)
        try:
            inspect.signature(step).bind(self.builder, x, *values, **named)
        except TypeError:
            fits = False
        if not fits:
            usage = ", ".join(list(inspect.signature(step).parameters)[2:]) or "nothing"
            _refuse(where, f"{word} with {usage}", " ".join([word, *arguments]), "see deploy/dpu/zoo/notation.py")
        return step(self.builder, x, *values, **named)

    def _value(self, text: str, where: str) -> Value:
        """A kept result, a size or a number."""
        if text in self.names:
            return self.names[text]
        if size := re.fullmatch(r"(\d+)x(\d+)", text):
            return int(size[1]), int(size[2])
        return self._number(text, where)

    def _number(self, text: str, where: str) -> int:
        try:
            number = self._evaluate(ast.parse(text, mode="eval").body)
        except (SyntaxError, ValueError, ArithmeticError, RecursionError):
            number = -1
        if not 0 <= number <= LARGEST:
            _refuse(where, f"a whole number of 0 to {LARGEST}, or a name given before", text, "correct it")
        return number

    def _evaluate(self, node: ast.expr) -> int:
        value: object = node.value if isinstance(node, ast.Constant) else None
        value = self.names.get(node.id) if isinstance(node, ast.Name) else value
        if isinstance(value, int) and not isinstance(value, bool):
            return value
        if not isinstance(node, ast.BinOp) or type(node.op) not in SIGNS:
            raise ValueError(ast.dump(node))
        left, right = self._evaluate(node.left), self._evaluate(node.right)
        if isinstance(node.op, ast.Div) and left % right:
            raise ValueError("not exact")
        return SIGNS[type(node.op)](left, right)


def _has_zero(value: Value) -> bool:
    return 0 in value if isinstance(value, tuple) else value == 0


def _refuse(where: str, expected: str, got: str, remedy: str) -> NoReturn:
    raise ModelError(where, expected=expected, got=got, remedy=remedy)
