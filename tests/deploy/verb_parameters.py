"""The parameters of all commands, what their annotations state about paths, and values for them."""

from dataclasses import dataclass
from inspect import Parameter
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from beers_deploy.cli.commands import COMMANDS
from beers_deploy.cli.generate import metavar_of, option_of, read_as
from beers_deploy.verbs.parameters import Holds, Interval, Written
from beers_deploy.verbs.verb import marker

GIVEN = {
    "bits_per_pixel": "2",
    "brightness": "0.5",
    "cases": "night",
    "classes": "car=vehicle",
    "dpu": "C32B3",
    "edge": "a.tif:0,0,9,9",
    "finetune": "3",
    "halo": "8",
    "methods": "degraded",
    "mtf": "0.07",
    "network": "network.onnx",
    "recipe": "recipe.toml",
    "reference": "pleiades-reference",
    "scheduler": "tcp://host:8786",
    "sensor": "pleiades-degraded",
    "size": "64x64",
    "split": "test",
    "stages": "INT8",
    "target": "zcu102",
    "tile": "320",
    "variant": "convbeers-xs",
    "with_": "haze",
    "without": "haze",
}
"""Texts that are not the default and that are valid by themselves."""


@dataclass(frozen=True)
class Option:
    """A parameter of a verb on the command line."""

    command: str
    parameter: Parameter

    @property
    def name(self) -> str:
        return self.parameter.name

    @property
    def is_argument(self) -> bool:
        return self.parameter.kind is Parameter.POSITIONAL_OR_KEYWORD

    @property
    def label(self) -> str:
        """Return the option as it is typed. A switch that is on by default has a --no- in front."""
        if self.is_argument:
            return metavar_of(self.parameter)
        option = option_of(self.name)
        return f"--no-{option[2:]}" if self.parameter.default is True else option

    @property
    def written(self) -> Written | None:
        return marker(self.parameter, Written)

    @property
    def holds(self) -> Holds | None:
        return marker(self.parameter, Holds)

    @property
    def required(self) -> bool:
        default = self.parameter.default is Parameter.empty
        return default or bool(self.written and self.written.required)

    @property
    def is_input(self) -> bool:
        """Return True for a path that is read. Names of shipped files may be paths as well."""
        named = self.name in ("sensor", "reference", "target", "network", "methods", "name")
        names = self.name.endswith("_network") or named
        return self.written is None and (names or read_as(self.parameter.annotation)[0] is Path)

    def words(self, value: object) -> list[str]:
        """Return the parameter with a value, as words of a command line."""
        return [str(value)] if self.is_argument else [self.label, str(value)]

    def switched(self) -> list[str]:
        """Return the parameter with a value that is not its default, as words of a command line."""
        hint, _ = read_as(self.parameter.annotation)
        if hint is bool:
            return [self.label]
        return self.words(self.value(hint))

    def value(self, hint: Any) -> object:
        """Return a value that is not the default."""
        if self.name in GIVEN and hint is not Path:
            return GIVEN[self.name]
        if hint is Path:
            return f"new-{self.name}.onnx" if self.written else existing(f"{self.name}.tif")
        if get_origin(hint) is Literal:
            return next(each for each in get_args(hint) if each != self.parameter.default)
        interval = marker(self.parameter, Interval)
        least = 1 if interval is None else max(int(str(interval.ge)), 1)
        number = least + 1 if least == self.parameter.default else least
        return str(number) if hint in (int, float) else "a"


def existing(name: str) -> str:
    Path(name).touch()
    return name


def options(command: str) -> dict[str, Option]:
    """Return the parameters of a command by name, in the order of its help."""
    return {
        parameter.name: Option(command, parameter) for parameter in COMMANDS[command].parameters
    }
