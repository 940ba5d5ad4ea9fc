"""Read networks from the `.net` files in `zoo/`.

Their notation is:

    block basic c                  # a block has parameters, some with defaults: block down c s=2
        conv c | conv c | add x    # a line is steps, each reading the result of the step before

    network small
        family resnet                      # networks of one family resemble one another
        host   argmax              # what the host does with the results: copy argmax softmax
                                   # sort image, or none, if the rates are the DPU's alone
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

    conv C [K=3 [S=1]] [d=1] [valid]          convolution into C channels: kernel, stride,
                                              dilation
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
    out [CHANNELS]                            a result, of which the host reads so many channels

Sizes are divided by a stride and rounded up, unless `valid` (no padding) or `ceil` (no padding
before an image, as much as needed behind it). A network without `out` has one result, its last x,
read whole. Batch norms and activations behind a convolution are fused into it and not written.
Every file knows the blocks of all files.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, get_args

from beers_deploy.dpu.cost.host import Task
from benchmarks.cost_model.builder import Builder, Tensor, Written

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
    "concat": Builder.concat,
    "out": Builder.out,
}
KINDS = {
    "images": "image-to-image",
    "segmentation": "segmentation",
    "detectors": "detectors",
    "yolo": "detectors",
    "classifiers": "classifiers",
    "inceptions": "classifiers",
}
"""The kind of the networks in each file."""
SIZE = re.compile(r"\b(\d+)x(\d+)\b")
FLAG = re.compile(r"\b(valid|ceil)\b")
HEADER = ("family", "host", "gop", "source", "image")


@dataclass
class Block:
    """A named block: its lines, and its parameters with the text of their defaults."""

    parameters: dict[str, str]
    lines: list[str] = field(default_factory=list)


@dataclass
class Entry:
    """A network in a file: its kind, its header and its lines."""

    kind: str
    header: dict[str, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)

    @property
    def family(self) -> str:
        """The name of the family, whose networks resemble one another."""
        return self.header["family"]

    @property
    def host(self) -> Task | None:
        """The host's task with the results, or None if the rates are the DPU's alone."""
        return next((task for task in get_args(Task) if task == self.header["host"]), None)

    @property
    def operations(self) -> float:
        """The published operations for one image, two for a product."""
        return 1e9 * float(self.header["gop"])


@dataclass(frozen=True)
class Library:
    """The blocks and networks of some files."""

    blocks: dict[str, Block] = field(default_factory=dict)
    networks: dict[str, Entry] = field(default_factory=dict)

    def write(self, name: str) -> Written:
        """Return one network, layer by layer.

        Raises:
            ValueError: shapes do not fit.
        """
        entry = self.networks[name]
        builder = Builder(*map(int, entry.header["image"].split()))
        return builder.written(self._run(builder, entry.lines, {"x": builder.image}))

    def _run(self, builder: Builder, lines: Sequence[str], names: dict[str, Any]) -> Tensor:
        """Append the steps of some lines, and return their last x."""
        result: Tensor
        for line in lines:
            name, equals, steps = line.partition(" = ")
            result = names["x"]
            names["ch"] = result.channels
            for step in (steps if equals else line).split("|"):
                result = self._step(builder, result, step.strip(), names)
            names[name if equals else "x"] = result
        result = names["x"]
        return result

    def _step(self, builder: Builder, x: Tensor, step: str, names: dict[str, Any]) -> Tensor:
        if isinstance(kept := names.get(step), Tensor):
            return kept
        step, _, times = step.partition(" *")
        word, *texts = step.split()
        for _ in range(_value(times or "1", names)):
            if word in STEPS:
                call = FLAG.sub(r"\1=1", ", ".join(texts))
                x = _value(f"step({call})", {**names, "step": partial(STEPS[word], builder, x)})
            else:
                block = self.blocks[word]
                arguments = block.parameters | dict(zip(block.parameters, texts, strict=False))
                values = {key: _value(text, names) for key, text in arguments.items()}
                x = self._run(builder, block.lines, {**values, "x": x})
        return x


def _value(text: str, names: Mapping[str, Any]) -> Any:
    """Evaluate a number, a size or a stored result: expressions of Python, but for 1x7 and `/`."""
    python = SIZE.sub(r"(\1, \2)", text).replace("/", "//")
    return eval(python, {}, dict(names))  # noqa: S307 - files of this folder


def read_library(paths: Sequence[Path]) -> Library:
    """Read the blocks and networks of `.net` files."""
    library = Library()
    target: Block | Entry = Block({})
    for path in paths:
        for text in path.read_text(encoding="utf-8").splitlines():
            line = text.partition("#")[0].rstrip()
            kind, _, rest = line.strip().partition(" ")
            if not line:
                continue
            if line[0].isspace():
                if isinstance(target, Entry) and kind in HEADER:
                    target.header[kind] = rest.strip()
                else:
                    target.lines.append(line.strip())
            elif kind == "block":
                name, *parameters = rest.split()
                pairs = (parameter.partition("=") for parameter in parameters)
                target = library.blocks[name] = Block({key: text for key, _, text in pairs})
            else:
                target = library.networks[rest.strip()] = Entry(KINDS[path.stem])
    return library
