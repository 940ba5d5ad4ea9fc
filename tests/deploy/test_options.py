"""Every option of every command, as docs/make/options.py lists them: what it takes, and what it
must not meet.
"""

from collections.abc import Iterator
from enum import StrEnum
from itertools import chain
from pathlib import Path

import pytest
from typer.testing import CliRunner

from beers_deploy.cli import COMMANDS, app
from docs.make.options import PATHS, REFUSED, UNITS, WORDS, Parameter, Refused, parameters


def refused_options() -> Iterator[tuple[str, str, Refused]]:
    """Yield a command, one of its options, and a combination in which the option is refused."""
    for name, cases in REFUSED.items():
        for case in cases:
            for option in case.options:
                yield name, option, case


GIVEN = {
    "add": "haze",
    "dpu": "C32B3",
    "halo": "8",
    "reference": "pleiades-reference",
    "scheduler": "tcp://host:8786",
    "sensor": "pleiades-degraded",
    "size": "64x64",
    "target": "vck190",
    "variant": "convbeers-xs",
}
"""Of texts, where any other would be refused for itself."""


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_known(name: str) -> None:
    """A KeyError of `kind` is an option that the tables of docs/make/options.py lack."""
    known_parameters = parameters(name)
    assert all(parameter.kind for parameter in known_parameters)
    names = {parameter.name for parameter in known_parameters}
    paths = PATHS[name]
    assert {*paths.written, *paths.read, *paths.also_read} <= names
    for case in REFUSED.get(name, ()):
        assert set(case.options) <= names
    inputs = {*paths.read, *paths.also_read}
    assert all(
        not parameter.kind.startswith("output")
        for parameter in known_parameters
        if parameter.name in inputs
    )


def test_the_tables_hold_nothing_else() -> None:
    every_parameter = chain.from_iterable(parameters(name) for name in COMMANDS)
    names = {parameter.name for parameter in every_parameter}
    assert {*UNITS, *WORDS} <= names
    assert set(REFUSED) <= set(PATHS) == set(COMMANDS)


@pytest.mark.parametrize(("name", "option", "case"), list(refused_options()), ids=str)
def test_a_combination_is_refused(
    name: str, option: str, case: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    by_name = {parameter.name: parameter for parameter in parameters(name)}
    beside = [_file(word) if word.isupper() else word for word in case.beside.split()]
    needed: list[str] = []
    for parameter in by_name.values():
        if parameter.required:
            needed += _given(parameter)
    command = [name, *needed, *beside, *_given(by_name[option])]
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2, (command, result.output)
    sentence = result.stderr.removeprefix("beers-deploy: ")
    assert sentence.startswith(
        (by_name[option].label, *case.without.split(), *(b for b in beside if b[0] == "-"))
    )
    assert result.stderr.count("\n") == 1, result.stderr
    assert sorted(tmp_path.rglob("*")) == before


def _file(name: str) -> str:
    Path(name).touch()
    return name


def _given(parameter: Parameter) -> list[str]:
    """The parameter with a value that is none of its default, as words of a command line."""
    if parameter.hint is bool:
        return [parameter.label]
    value = _value(parameter)
    return [parameter.label, value] if parameter.label.startswith("-") else [value]


def _value(parameter: Parameter) -> str:
    if parameter.hint is Path:
        is_output = parameter.kind.startswith("output")
        return f"new-{parameter.name}.svg" if is_output else _file(f"{parameter.name}.tif")
    if parameter.hint in (int, float):
        least = parameter.info.min or 0
        most = parameter.info.max
        return str(max(least, 1) if most is None else min(max(least, 1), most))
    if issubclass(parameter.hint, StrEnum):
        return str(list(parameter.hint)[-1])
    return GIVEN.get(parameter.name, "a")
