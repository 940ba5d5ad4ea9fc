"""Networks as text: the notation of the `.net` files in `zoo/`, and its reader.

    block basic c                  # a block has parameters, some with defaults: block down c s=2
        conv c | conv c | add x    # a line is steps, each reading the result of the step before

    network small
        family resnet                      # networks of one family resemble one another
        host   argmax              # what the host does with the results: copy argmax softmax
                                   # sort image, or none, where the rates are the DPU's alone
        gop    1.2                 # published operations (two a product), in 10^9
        source He et al. 2015      # where the layers are written
        image  224 224             # height, width, and channels if not 3
        conv 64 7 2 | pool 3 2
        y = basic 64 *2            # twice; the result is kept as y, and x stays what it was
        conv 64 1 | add y          # this result is x, where the next line starts
        y | conv 32 | out          # a line may start from a kept result
        global | fc 1000

`x` is where a line starts: the result of the last line without a name. `ch` is its number of
channels. A number may be a sum, difference, product or exact quotient of numbers, parameters and
`ch`, without spaces: `4*c`, `ch/2`. A size is one number or HEIGHTxWIDTH: `1x7`. A parameter of a
block may also stand for a kept result. In a block, x is what the block was called on, and its last
x is what it returns.

    conv C [K=3 [S=1]] [d=1] [g=1] [valid]    convolution into C channels: kernel, stride,
                                              dilation, groups
    dw [K=3 [S=1]] [d=1] [m=1]                depthwise, into m times the channels
    transposed C K S                          transposed convolution, S times as large
    fc C                                      fully connected
    pool K S [valid|ceil]                     largest of a window
    mean K S [valid|ceil]                     mean of a window
    global                                    mean of each channel
    scale                                     batch norm that no convolution can take in
    resize [N=2|NAME]                         N times as large, or as a kept result
    bilinear [N=2|NAME]                       the same, bilinear instead of nearest neighbour
    shuffle [N=2]    unshuffle [N=2]          channels to N x N pixels and back
    add NAME...      concat NAME...           joins the result so far with kept ones
    mul NAME                                  the same, a product
    slice FIRST COUNT                         some of the channels
    hsigmoid         hswish                   an activation that is a step of its own
    out [CHANNELS]                            a result, of which the host reads so many channels

Sizes are divided by a stride and rounded up, unless `valid` (no padding) or `ceil` (no padding
before an image, as much as needed behind it). A network without `out` has one result, its last x,
read whole. Batch norms and activations behind a convolution are fused into it and not written.
Every file knows the blocks of all files.
"""

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import get_args

from beers_deploy.dpu.cost.model import Task
from benchmarks.cost_model.builder import Builder, Size, Tensor, Written

Value = Tensor | Size

STEPS: Mapping[str, Callable[..., Tensor]] = {
    "conv": Builder.conv,
    "dw": Builder.depthwise,
    "transposed": Builder.transposed,
    "fc": lambda builder, x, channels: builder.conv(x, channels, x.shape[1:], valid=1),
    "pool": Builder.pool,
    "mean": partial(Builder.pool, op_type="AveragePool"),
    "global": Builder.global_mean,
    "scale": lambda builder, x: builder.depthwise(x, 1),
    "resize": Builder.resize,
    "bilinear": partial(Builder.resize, linear=True),
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
SIGNS: Mapping[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.floordiv,
}
KINDS = {
    "images": "image-to-image",
    "segmentation": "segmentation",
    "detectors": "detectors",
    "yolo": "detectors",
    "classifiers": "classifiers",
    "inceptions": "classifiers",
}
"""What the networks of a file do."""
HEADER = ("family", "host", "gop", "source", "image")


@dataclass
class Block:
    """Lines under a name, each with its place; parameters with the text of their defaults."""

    parameters: Mapping[str, str | None]
    lines: list[tuple[str, str]] = field(default_factory=list)


@dataclass
class Entry:
    """A network of a file: what it does, its header, and its lines, each with its place."""

    kind: str = ""
    header: dict[str, str] = field(default_factory=dict)
    lines: list[tuple[str, str]] = field(default_factory=list)

    @property
    def family(self) -> str:
        """Networks of one family resemble one another."""
        return self.header["family"]

    @property
    def host(self) -> Task | None:
        """What the host does with the results; None where the rates are the DPU's alone."""
        return next((task for task in get_args(Task) if task == self.header["host"]), None)

    @property
    def operations(self) -> float:
        """Published operations for one image, two a product."""
        return 1e9 * float(self.header["gop"])


@dataclass(frozen=True)
class Library:
    """The blocks and networks of some files."""

    blocks: Mapping[str, Block]
    networks: Mapping[str, Entry]

    def write(self, name: str) -> Written:
        """One network, layer by layer.

        Raises:
            ValueError: a line that cannot be understood, or shapes that do not fit; it names file
                and line.
        """
        entry = self.networks[name]
        scope = _Scope(self.blocks, Builder(*map(int, entry.header["image"].split())), {})
        for place, line in entry.lines:
            try:
                scope.run(line)
            except (
                ArithmeticError,
                AssertionError,
                LookupError,
                SyntaxError,
                TypeError,
                ValueError,
            ) as error:
                raise ValueError(f"{place}: {line} ({error})") from error
        return scope.builder.written(scope.x)


def read_library(paths: Sequence[Path]) -> Library:
    """The blocks and networks of `.net` files."""
    blocks: dict[str, Block] = {}
    networks: dict[str, Entry] = {}
    target: Block | Entry = Entry()
    for path in paths:
        for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            line = text.partition("#")[0].rstrip()
            kind, _, rest = line.strip().partition(" ")
            if not line:
                continue
            if line[0].isspace():
                if isinstance(target, Entry) and kind in HEADER and kind not in target.header:
                    target.header[kind] = rest.strip()
                else:
                    target.lines.append((f"{path.name}, line {number}", line.strip()))
            elif kind == "block":
                name, *parameters = rest.split()
                pairs = (parameter.partition("=") for parameter in parameters)
                target = blocks[name] = Block({key: default or None for key, _, default in pairs})
            else:
                target = networks[rest.strip()] = Entry(KINDS[path.stem])
    return Library(blocks, networks)


class _Scope:
    """A network or a block while its lines are read."""

    def __init__(
        self, blocks: Mapping[str, Block], builder: Builder, names: Mapping[str, Value]
    ) -> None:
        self.blocks = blocks
        self.builder = builder
        self.names: dict[str, Value] = {"x": builder.image, **names}

    @property
    def x(self) -> Tensor:
        """Where a line starts."""
        tensor = self.names["x"]
        assert isinstance(tensor, Tensor)  # noqa: S101 - x is kept by `run` alone
        return tensor

    def run(self, line: str) -> None:
        """Take all steps of a line."""
        name, equals, steps = line.partition(" = ")
        result = self.x
        self.names["ch"] = result.channels
        for step in (steps if equals else line).split("|"):
            result = self._step(result, step.split())
        self.names[name if equals else "x"] = result

    def _step(self, x: Tensor, words: list[str]) -> Tensor:
        times = self._number(words.pop()[1:]) if words[-1].startswith("*") else 1
        if len(words) == 1 and isinstance(tensor := self.names.get(words[0]), Tensor):
            return tensor
        for _ in range(times):
            x = self._call(x, words[0], words[1:])
        return x

    def _call(self, x: Tensor, word: str, arguments: list[str]) -> Tensor:
        if word in STEPS:
            options = [text.partition("=") for text in arguments if "=" in text or text in FLAGS]
            values = [
                self._value(text) for text in arguments if "=" not in text and text not in FLAGS
            ]
            return STEPS[word](
                self.builder, x, *values, **{k: self._number(text or "1") for k, _, text in options}
            )
        block = self.blocks[word]
        texts = {**block.parameters, **dict(zip(block.parameters, arguments, strict=False))}
        scope = _Scope(
            self.blocks,
            self.builder,
            {**{k: self._value(str(v)) for k, v in texts.items()}, "x": x},
        )
        for _, line in block.lines:
            scope.run(line)
        return scope.x

    def _value(self, text: str) -> Value:
        """A kept result, a size or a number."""
        if text in self.names:
            return self.names[text]
        height, times, width = text.partition("x")
        if times and height.isdecimal() and width.isdecimal():
            return int(height), int(width)
        return self._number(text)

    def _number(self, text: str) -> int:
        return self._evaluate(ast.parse(text, mode="eval").body)

    def _evaluate(self, node: ast.expr) -> int:
        """A whole number, a name of one, or a sum, difference, product or exact
        quotient of such.
        """
        if isinstance(node, ast.BinOp):
            left = self._evaluate(node.left)
            right = self._evaluate(node.right)
            if isinstance(node.op, ast.Div) and left % right:
                raise ValueError(f"{left} / {right} is not exact")
            return SIGNS[type(node.op)](left, right)
        value: object = (
            self.names.get(node.id) if isinstance(node, ast.Name) else ast.literal_eval(node)
        )
        if not isinstance(value, int):
            raise ValueError(f"no number: {ast.unparse(node)}")
        return value
