"""What every option of every command takes, for docs/make/commands.py, and what it is refused with,
for tests.

Types are read from the commands. The tables below hold what the commands do not say themselves.
Tests give every command each combination of options that it is said to refuse, and fail for an
option that is in no table.
"""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from typer.main import get_command

from beers_deploy.cli import COMMANDS, app

FILE = "file"
FOLDER = "folder"


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
    "train": Paths(
        {"out": FOLDER}, ("images", "pairs", "lpips", "start", "rounding"), ("sensor", "reference")
    ),
    "export": Paths(
        {"out": FILE, "board_file": FILE, "delta": FILE}, ("network", "apply"), ("sensor", "target")
    ),
    "quantize": Paths(
        {"out": FILE, "board_file": FILE, "report": FOLDER, "json": FILE},
        ("model", "images", "samples"),
        ("sensor", "target"),
    ),
    "gate": Paths(
        {"junit": FILE, "record": FOLDER, "json": FILE},
        ("float_model", "int8_model", "limits", "baseline", "images", "samples"),
        ("sensor", "target"),
    ),
    "check": Paths({"picture": FILE, "json": FILE}, ("model",), ("target",)),
    "golden": Paths({"out": FOLDER, "json": FILE}, ("given", "compare"), ("target",)),
    "bench": Paths({"json": FILE}, ("model", "image", "measured"), ("sensor", "target")),
    "restore": Paths(
        {"out": FILE, "json": FILE, "stac": FILE}, ("image", "network"), ("sensor", "fix_detectors")
    ),
    "evaluate": Paths(
        {"out": FOLDER, "json": FILE},
        ("images", "pairs", "lpips"),
        ("sensor", "reference", "methods"),
    ),
    "detect": Paths(
        {"out": FOLDER, "json": FILE},
        ("images", "labels", "detector"),
        ("sensor", "reference", "methods"),
    ),
    "stress": Paths(
        {"out": FILE, "json": FILE}, ("float_model", "int8_model", "images"), ("sensor", "target")
    ),
    "tradeoff": Paths(
        {"out": FOLDER, "json": FILE},
        ("images", "lpips", "calibration", "labelled", "detector"),
        ("sensor", "reference", "network", "target"),
    ),
}

UNITS = {
    "batch": "patches",
    "bits": "bit",
    "black_level": "number",
    "budget": "s",
    "drawn": "scenes",
    "draws": "draws",
    "fft_weight": "weight",
    "gain": "number",
    "gsd": "m",
    "full_scale": "number",
    "l1_weight": "weight",
    "learning_rate": "per step",
    "lpips_weight": "weight",
    "max_mae": "of full scale",
    "memory": "GB",
    "oversampling": "number",
    "patch": "px",
    "patches": "patches",
    "psnr_weight": "weight",
    "seed": "integer",
    "side": "px",
    "steps": "steps",
    "threads": "threads",
    "tile": "px",
    "tolerance": "DN",
    "validate_every": "steps",
    "workers": "processes",
    "within": "s",
}
"""Of numbers."""

WORDS = {
    "add": "effect",
    "brightness": "factors",
    "budget": "limits",
    "cases": "names",
    "classes": "pairs",
    "device": "cpu, cuda",
    "dpu": "configuration",
    "edge": "box",
    "finetune": "auto, or steps",
    "fix_detectors": "found",
    "forbid": "effect",
    "halo": "px",
    "methods": "names",
    "metric": "name",
    "mtf": "ratios",
    "name": "profile",
    "need": "limits",
    "network": "network",
    "preset": "data set",
    "recipe": "recipe",
    "reference": "profile",
    "scene": "scene",
    "scheduler": "address",
    "sensor": "profile",
    "size": "px",
    "split": "list",
    "stages": "names",
    "target": "board",
    "tile": "px",
    "variant": "network",
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
        Refused(
            ("sensor", "variant", "steps", "seed", "validate_every"),
            "--recipe convbeers-xs --images aerial/",
        ),
        Refused(("images", "drawn", "conditioned"), "--pairs PAIRS"),
        Refused(("validate_every",), without="--images"),
        Refused(("lpips",), "--lpips-weight 0"),
        Refused(("rounding",), without="--conditioned"),
    ],
    "export": [
        Refused(("board_file", "delta", "apply"), without="--network"),
        Refused(("target",), without="--board-file"),
    ],
    "quantize": [
        Refused(("tile",), without="--board-file"),
    ],
    "golden": [
        Refused(("tile", "target"), "--compare COMPARE"),
        Refused(("json",), without="--compare"),
    ],
    "bench": [
        Refused(
            (
                "image",
                "full_scale",
                "size",
                "halo",
                "dpu",
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
            ("network", "tile", "halo", "runtime", "threads", "scheduler", "resume", "dry_run"),
            "--method traditional",
        ),
        Refused(("method",), without="--sensor"),
        Refused(("stac",), without="--cog"),
    ],
    "evaluate": [Refused(("images", "sweep", "brightness"), "--pairs PAIRS")],
    "detect": [
        Refused(("labels", "split"), without="--images"),
        Refused(("drawn",), "--images IMAGES"),
    ],
    "tradeoff": [Refused(("detector", "classes"), without="--labelled")],
    "stress": [
        Refused(("cases", "stages"), "--bit-flips"),
        Refused(("draws", "images", "target"), without="--bit-flips"),
    ],
}


@dataclass(frozen=True)
class Parameter:
    """An argument or option of a command: its names in Python and on the command line, its type and
    range.

    `shown` is what the command line makes of it: Click's parameter.
    """

    command: str
    name: str
    label: str
    required: bool
    hint: Any
    info: Any
    shown: Any

    @property
    def kind(self) -> str:
        """What it takes: a path, a flag, one of several words, the unit of a number, or a text.

        Raises:
            KeyError: the tables above do not know it.
        """
        paths = PATHS[self.command]
        if self.hint is Path:
            return f"output {paths.written[self.name]}" if self.name in paths.written else "input"
        if self.hint is bool:
            return "flag"
        if self.hint in (int, float):
            return UNITS[self.name]
        if issubclass(self.hint, StrEnum):
            return ", ".join(self.hint)
        return WORDS[self.name] + (" or file" if self.name in paths.also_read else "")


def parameters(command: str) -> list[Parameter]:
    """Of a command, in the order of its help."""
    hints = get_type_hints(COMMANDS[command][0], include_extras=True)
    entries = []
    for option in get_command(app).commands[command].params:  # type: ignore[attr-defined]
        if option.name in hints:
            hint, info = get_args(hints[option.name])
            is_option = option.param_type_name == "option"
            label = (
                max(option.opts, key=len)
                if is_option
                else (option.metavar or option.name.upper()).strip("[]")
            )
            entries.append(
                Parameter(command, option.name, label, option.required, _plain(hint), info, option)
            )
    return entries


def _plain(hint: Any) -> Any:
    """A hint without None and without the list around it."""
    within = [kind for kind in get_args(hint) if kind is not NoneType]
    if not within:
        return hint
    return _plain(within[0]) if get_origin(hint) is list or len(within) == 1 else hint
