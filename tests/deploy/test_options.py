"""Every option of every command, as docs/make/options.py lists them: what it takes, and what it
must not meet.
"""

from enum import StrEnum
from pathlib import Path

import pytest
from typer.testing import CliRunner

from beers_deploy.cli import COMMANDS, app
from docs.make.options import PATHS, REFUSED, UNITS, WORDS, Parameter, Refused, parameters

CASES = [
    (name, option, case)
    for name, cases in REFUSED.items()
    for case in cases
    for option in case.options
]
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
    known = parameters(name)
    assert all(each.kind for each in known)
    names = {each.name for each in known}
    paths = PATHS[name]
    assert {*paths.written, *paths.read, *paths.also_read} <= names
    assert {option for case in REFUSED.get(name, ()) for option in case.options} <= names
    read = {*paths.read, *paths.also_read}
    assert all(not each.kind.startswith("output") for each in known if each.name in read)


def test_the_tables_hold_nothing_else() -> None:
    used = {each.name for name in COMMANDS for each in parameters(name)}
    assert {*UNITS, *WORDS} <= used
    assert set(REFUSED) <= set(PATHS) == set(COMMANDS)


@pytest.mark.parametrize(("name", "option", "case"), CASES, ids=lambda each: str(each))
def test_a_combination_is_refused(
    name: str, option: str, case: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    known = {each.name: each for each in parameters(name)}
    beside = [_file(word) if word.isupper() else word for word in case.beside.split()]
    needed = [word for each in known.values() if each.required for word in _given(each)]
    command = [name, *needed, *beside, *_given(known[option])]
    before = sorted(tmp_path.rglob("*"))
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2, (command, done.output)
    sentence = done.stderr.removeprefix("beers-deploy: ")
    assert sentence.startswith(
        (known[option].label, *case.without.split(), *(b for b in beside if b[0] == "-"))
    )
    assert done.stderr.count("\n") == 1, done.stderr
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
        written = parameter.kind.startswith("output")
        return f"new-{parameter.name}.svg" if written else _file(f"{parameter.name}.tif")
    if parameter.hint in (int, float):
        least = parameter.info.min or 0
        most = parameter.info.max
        return str(max(least, 1) if most is None else min(max(least, 1), most))
    if issubclass(parameter.hint, StrEnum):
        return str(list(parameter.hint)[-1])
    return GIVEN.get(parameter.name, "a")
