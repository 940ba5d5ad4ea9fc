"""Write docs/reference/options.md, an audit of every option of every command: `python docs/make/options.py`.

Types and ranges are read from the commands; what they do not say of themselves stands in the tables below. A test
keeps the page fresh, gives every command each pair of options that it is said to refuse, and fails for an option that
the tables do not know.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from typer.main import get_command

from deploy.cli import COMMANDS, app
from model.processor import SEEDS

TARGET = Path(__file__).parents[1] / "reference" / "options.md"
FILE, FOLDER = "file", "folder"


@dataclass(frozen=True)
class Paths:
    """What a command does with the paths that it takes.

    Attributes:
        written: parameters that are outputs: FILE or FOLDER.
        read: parameters that are inputs.
        also_read: options that take a file where others take a name.
    """

    written: dict[str, str]
    read: tuple[str, ...] = ()
    also_read: tuple[str, ...] = ()


PATHS = {
    "demo": Paths({"out": FOLDER, "json": FILE}, ("image",), ("sensor",)),
    "profiles": Paths({}, (), ("name",)),
    "characterise": Paths({"out": FILE, "json": FILE}, ("images",)),
    "simulate": Paths({"out": FOLDER}, ("scenes",), ("sensor", "reference", "scene")),
    "train": Paths({"out": FOLDER}, ("images", "pairs", "lpips", "start", "teacher"), ("sensor", "reference")),
    "export": Paths({"out": FILE, "board": FILE, "delta": FILE}, ("checkpoint", "apply"), ("sensor",)),
    "quantize": Paths(
        {"out": FILE, "board": FILE, "report": FOLDER, "json": FILE},
        ("model", "images", "data"),
        ("sensor", "target"),
    ),
    "gate": Paths(
        {"junit": FILE, "json": FILE},
        ("float_model", "int8_model", "config", "baseline", "images", "data"),
        ("sensor", "target"),
    ),
    "check": Paths({"picture": FILE, "json": FILE}, ("model",), ("target",)),
    "bench": Paths({"json": FILE}, ("model", "image", "measured"), ("target",)),
    "info": Paths({"json": FILE}, ("image", "model"), ("sensor", "target")),
    "restore": Paths({"out": FILE, "json": FILE, "stac": FILE}, ("image", "model"), ("sensor",)),
    "evaluate": Paths(
        {"out": FOLDER, "json": FILE}, ("images", "pairs", "lpips"), ("sensor", "reference", "methods")
    ),
    "detect": Paths(
        {"out": FOLDER, "json": FILE}, ("images", "labels", "detector"), ("sensor", "reference", "methods")
    ),
    "stress": Paths({"out": FILE, "json": FILE}, ("float_model", "int8_model", "images"), ("sensor", "target")),
    "tradeoff": Paths(
        {"out": FOLDER, "json": FILE},
        ("images", "lpips", "calibration", "labelled", "detector", "network"),
        ("sensor", "reference", "networks", "target"),
    ),
    "compare": Paths({"json": FILE}, ("before", "after")),
}

UNITS = {
    "batch": "patches",
    "bits": "bit",
    "budget": "s",
    "distil": "a weight",
    "drawn": "scenes",
    "draws": "draws",
    "fft_weight": "a weight",
    "finetune": "steps",
    "gain": "DN per W/m2/sr/um, above 0",
    "gsd": "m, above 0",
    "full_scale": "pixel value above 0",
    "l1_weight": "a weight",
    "l2_weight": "a weight",
    "learning_rate": "a step",
    "lpips_weight": "a weight",
    "max_mae": "of full scale",
    "memory": "GB",
    "oversampling": "scene pixels a pixel",
    "patch": "px",
    "patches": "patches",
    "radiance_weight": "a weight",
    "psnr_weight": "a weight",
    "rough": "of the patches",
    "seed": "no unit",
    "size": "px",
    "steps": "steps",
    "threads": "threads, at most the cores",
    "tile": "px",
    "tolerance": "DN",
    "validate_every": "steps",
    "workers": "processes, at most the cores",
    "within": "s",
}
"""Of numbers."""

WORDS = {
    "add": "an effect's name",
    "budget": "limits such as latency<=20s",
    "cases": "names of cases, with commas",
    "classes": "pairs such as car=vehicle, with commas",
    "config": "C32B1 to C64B5",
    "device": "cpu or cuda",
    "edge": "FILE:X,Y,WIDTH,HEIGHT in px",
    "fail_on": "a change such as PSNR<-0.05",
    "forbid": "an effect's name",
    "halo": "exact, or whole px from 0",
    "methods": "names, with commas",
    "name": "a profile's name",
    "need": "limits such as psnr>=44",
    "networks": "names, with commas",
    "optimiser": "adam or adamw",
    "preset": "a data set's name",
    "reference": "a profile's name",
    "scene": "a scene's name",
    "scheduler": "an address such as tcp://host:8786",
    "sensor": "a profile's name",
    "size": "width x height in px, such as 13600x9016",
    "split": "the name of a list of pictures",
    "stages": "names of stages, with commas",
    "target": "a board's name",
    "tile": "px, several with commas",
    "variant": "a network's name",
}
"""Of what is read as text."""


@dataclass(frozen=True)
class Refused:
    """Options that one command refuses together.

    Attributes:
        options: each of these parameters,
        beside: where these words stand on the command line,
        without: or where this option does not. Words in capitals are files.
    """

    options: tuple[str, ...]
    beside: str = ""
    without: str = ""

    def __str__(self) -> str:
        return f"beside `{self.beside}`" if self.beside else f"without `{self.without}`"


SCHEDULER = "--scheduler tcp://host:8786"
REFUSED = {
    "demo": [Refused(("full_scale",), without="--image")],
    "profiles": [Refused(("toml",), without="NAME")],
    "simulate": [
        Refused(("workers",), f"--out OUT {SCHEDULER}"),
        Refused(("workers", "scheduler", "resume"), without="--out"),
    ],
    "train": [
        Refused(("images", "drawn", "conditioned", "rough"), "--pairs PAIRS"),
        Refused(("validate_every",), without="--images"),
        Refused(("distil",), without="--teacher"),
        Refused(("lpips",), "--lpips-weight 0"),
    ],
    "export": [
        Refused(("variant",), "--checkpoint WEIGHTS"),
        Refused(("board", "delta", "apply"), without="--checkpoint"),
    ],
    "quantize": [Refused(("board", "report", "finetune"), "--regime free")],
    "gate": [Refused(("variant",), "FLOAT INT8")],
    "bench": [
        Refused(
            (
                "image",
                "full_scale",
                "size",
                "halo",
                "config",
                "host_task",
                "measured",
                "no_traditional",
                "within",
                "layers",
            ),
            "--target host",
        ),
        Refused(("threads",), without="--target host"),
        Refused(("full_scale",), without="--image"),
        Refused(("size",), "--image IMAGE"),
    ],
    "restore": [
        Refused(
            ("model", "tile", "halo", "runtime", "threads", "scheduler", "cog", "stac", "resume"),
            "--method traditional",
        ),
        Refused(("method",), without="--sensor"),
        Refused(("stac",), without="--cog"),
    ],
    "evaluate": [Refused(("images", "sweep"), "--pairs PAIRS")],
    "detect": [
        Refused(("labels", "split"), without="--images"),
        Refused(("drawn",), "--images IMAGES"),
    ],
    "tradeoff": [Refused(("detector", "classes"), without="--labelled")],
    "stress": [
        Refused(("variant",), "FLOAT"),
        Refused(("cases", "stages"), "--bit-flips"),
        Refused(("draws", "images", "target"), without="--bit-flips"),
    ],
}


@dataclass(frozen=True)
class Parameter:
    """An argument or option of a command: its names in Python and on the command line, its type and range."""

    command: str
    name: str
    label: str
    required: bool
    hint: Any
    info: Any

    @property
    def kind(self) -> str:
        """What it takes: a path, a flag, one of several words, a number with its range and unit, or a text.

        Raises:
            KeyError: the tables above do not know it.
        """
        paths = PATHS[self.command]
        if self.hint is Path:
            return f"output {paths.written[self.name]}" if self.name in paths.written else "input"
        if self.hint is bool:
            return "flag"
        if self.hint in (int, float):
            return f"{'whole number' if self.hint is int else 'number'}{_range(self.info)}, {UNITS[self.name]}"
        if issubclass(self.hint, StrEnum):
            return " or ".join(self.hint)
        return WORDS[self.name] + (", or a file" if self.name in paths.also_read else "")

    @property
    def fate(self) -> str:
        """What becomes of a path."""
        paths = PATHS[self.command]
        if self.name in paths.written:
            whole = "written whole or not at all"
            return f"filled with files, each {whole}" if paths.written[self.name] == FOLDER else whole
        return "read" if self.name in (*paths.read, *paths.also_read) else ""

    @property
    def refused(self) -> str:
        """Where the command refuses it."""
        return "; ".join(str(case) for case in REFUSED.get(self.command, ()) if self.name in case.options)


def parameters(command: str) -> list[Parameter]:
    """Of a command, in the order of its help."""
    hints = get_type_hints(COMMANDS[command][0], include_extras=True)
    found = []
    for shown in get_command(app).commands[command].params:  # type: ignore[attr-defined]
        if shown.name in hints:
            hint, info = get_args(hints[shown.name])
            label = shown.opts[0] if shown.param_type_name == "option" else shown.metavar or shown.name.upper()
            found.append(Parameter(command, shown.name, label.strip("[]"), shown.required, _plain(hint), info))
    return found


def _plain(hint: Any) -> Any:
    """A hint without None and without the list around it."""
    within = [each for each in get_args(hint) if each is not NoneType]
    if not within:
        return hint
    return _plain(within[0]) if get_origin(hint) is list or len(within) == 1 else hint


def _range(info: Any) -> str:
    low, high = info.min, info.max
    if low is None:
        return ""
    return f" from {low}" if high is None else f", {low} to {'2^62' if high == SEEDS else high}"


def _lines() -> Iterator[str]:
    everything = [each for command in COMMANDS for each in parameters(command)]
    outputs = sum(each.kind.startswith("output") for each in everything)
    combinations = sum(len(case.options) for cases in REFUSED.values() for case in cases)
    yield "# Every option: what it takes, what it must not stand beside, what becomes of its path\n"
    yield "Generated by `python docs/make/options.py`; what each option does: [commands](commands.md).\n"
    yield f"{len(COMMANDS)} commands, {len(everything)} arguments and options, {outputs} of them outputs;"
    yield f"{combinations} combinations are refused, with exit code 2 and nothing written.\n"
    yield "An output is a regular file or a new name: no input, no other output, no link, pipe or device, and no file"
    yield "that is shipped. `--sensor` and `--reference` beside `--pairs` must be those that made the pairs.\n"
    for command in COMMANDS:
        yield f"## {command}\n\n| option | takes | refused | its path |\n|---|---|---|---|"
        for each in parameters(command):
            yield f"| `{each.label}` | {each.kind} | {each.refused} | {each.fate} |"
        yield ""


def page() -> str:
    """The page as Markdown."""
    return "\n".join(_lines())


if __name__ == "__main__":
    TARGET.write_text(page(), encoding="utf-8", newline="\n")
    sys.stdout.write(f"wrote {TARGET}\n")
