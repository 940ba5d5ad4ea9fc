"""Decorate a function as a verb: check its parameters, and record the call in its table."""

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from errno import EACCES, ELOOP, ENAMETOOLONG, EPERM
from functools import wraps
from inspect import Parameter, signature
from itertools import product
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar, cast, get_args, get_origin

from annotated_types import Interval

from beers_deploy.profiles.errors import (
    BeersError,
    MachineError,
    OptionError,
    missing_extra,
    printable,
)
from beers_deploy.verbs.parameters import Holds, InputPath, Labelled, NextTo, Wider, Written

P = ParamSpec("P")
R = TypeVar("R")

REFUSALS = (EACCES, ELOOP, ENAMETOOLONG, EPERM)
"""Errors of the system for paths that the user can correct."""
NOT_RECORDED = ("progress", "json", "junit")
"""Parameters that decide no figure."""


def verb(function: Callable[P, R]) -> Callable[P, R]:
    """Check the parameters of a function before it runs, and record them in its result.

    1. An older verdict is deleted, so that it does not pass for that of a run that is refused.
    2. A value outside the type, the interval or the choices of its annotation is refused, and so
       is an empty text, such as that of an unset variable.
    3. An output that is an input or another output is refused.
    4. The parameter `progress` decides how the work inside is reported.
    5. If an optional package is missing, the error names the extra that installs it. A path that
       may not be read or written is named too.
    6. A table that is returned names the verb and its arguments.
    """
    parameters = signature(function).parameters

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        from beers_deploy.model.progress import reporting
        from beers_deploy.results import Table

        bound = signature(function).bind(*args, **kwargs)
        bound.apply_defaults()
        delete_older(function, bound.arguments)
        for name, value in bound.arguments.items():
            require_allowed(parameters[name], value)
        require_apart(function, bound.arguments)
        with _errors_of_machine(function.__name__), reporting(bound.arguments.get("progress")):
            result = function(*args, **kwargs)

        def named(table: Table) -> Table:
            own = {**recorded(bound.arguments), **table.arguments}
            return replace(table, command=function.__name__, arguments=own)

        if isinstance(result, Table):
            return cast(R, named(result))
        # A network or a sensor that a verb returns may have a table of how it was made.
        table = getattr(result, "table", None)
        if isinstance(table, Table):
            return cast(R, replace(cast(Any, result), table=named(table)))
        return result

    return checked


@contextmanager
def _errors_of_machine(verb_name: str) -> Iterator[None]:
    """Raise MachineError if a package is missing, or if the system refuses a path."""
    try:
        yield
    except ImportError as error:
        if isinstance(error, BeersError):
            raise
        raise missing_extra(error, verb_name) from error
    except OSError as error:
        if error.errno not in REFUSALS:
            raise
        raise MachineError(
            f"{printable(str(error.filename))} cannot be read or written: {error.strerror}. Change "
            "its permissions, or choose another path."
        ) from error


def require_allowed(parameter: Parameter, value: object) -> None:
    """Raise OptionError if the annotation of a parameter does not allow its value.

    Args:
        parameter: annotated with its type, and perhaps with an `Interval` or a `Literal`.
        value: its value; the default is always allowed.
    """
    name = parameter.name
    if isinstance(value, str) and value == "":
        raise OptionError(f"`{name}` is empty. Give a value, or leave it out.")
    parts = list(parts_of(parameter.annotation))
    if value is parameter.default or (value is None and type(None) in parts):
        return
    _require_text(name, value, parts)
    # The text "no" would count as True.
    if bool in parts and isinstance(value, str):
        raise OptionError(f"`{name}` must be True or False, got {printable(repr(value))}.")
    if {int, float}.intersection(parts):
        _require_number(name, value, parts)
    for part in parts:
        # An array compares element by element.
        choices = get_args(part) if get_origin(part) is Literal else None
        if choices and not (isinstance(value, str | Real) and value in choices):
            names = ", ".join(map(repr, choices))
            given = printable(repr(value))
            raise OptionError(f"`{name}` must be one of {names}, got {given}.")


def _require_text(name: str, value: object, parts: list[Any]) -> None:
    """Raise OptionError if a text or a path, or one of several, has another type."""
    # Standard output is for the results document.
    if any(isinstance(part, Written) for part in parts) and str(value) == "-":
        raise OptionError(f"`{name}` must be a path, got '-'. Name the file or folder to write.")
    wider = next((part for part in parts if isinstance(part, Wider)), None)
    if (wider and not wider.names) or not {str, Path}.intersection(parts):
        return
    several = wider is not None or any(get_origin(part) is Sequence for part in parts)
    each = value if several and isinstance(value, list | tuple) else [value]
    kinds = (str, os.PathLike) if Path in parts else (str,)
    if all(isinstance(one, kinds) for one in each):
        return
    expected = "a path" if Path in parts else "a text"
    if several:
        expected += ", or a list of them"
    raise OptionError(f"`{name}` must be {expected}, got {printable(repr(value))}.")


def _require_number(name: str, value: object, parts: list[Any]) -> None:
    """Raise OptionError unless a value is a number of Python or NumPy, an integer if no float is
    allowed, and inside the parameter's interval.
    """
    # float() would read text, and would count True as 1.
    given = None if isinstance(value, bool) or not isinstance(value, Real) else value
    try:
        number = float(cast(float, given))
    except (TypeError, OverflowError) as error:
        raise OptionError(f"`{name}` must be one number, got {printable(repr(value))}.") from error
    if float not in parts and not isinstance(value, Integral):
        raise OptionError(f"`{name}` must be an integer, got {printable(repr(value))}.")
    for interval in (part for part in parts if isinstance(part, Interval)):
        low = -math.inf if interval.ge is None else float(str(interval.ge))
        high = math.inf if interval.le is None else float(str(interval.le))
        # NaN lies in no interval. An infinite number would be no valid JSON in the results.
        if low <= number <= high and not math.isinf(number):
            continue
        allowed = f"from {low:g} to {high:g}"
        if math.isinf(high):
            allowed = f"a finite number of at least {low:g}"
        raise OptionError(f"`{name}` must be {allowed}, got {number:g}.")


@dataclass(frozen=True)
class Paths:
    """The paths among the arguments of a verb.

    Attributes:
        outputs: files that are written.
        folders: folders that are filled with images.
        verdicts: outputs of which an older file is deleted first.
        inputs: files and folders that are read.
    """

    outputs: list[Path]
    folders: list[Path]
    verdicts: list[Path]
    inputs: list[Path]


def paths_of(function: Callable[..., Any], arguments: Mapping[str, Any]) -> Paths:
    """Return the paths among the arguments of a verb."""
    parameters = signature(function).parameters
    paths = Paths([], [], [], [])
    for name, value in arguments.items():
        parameter = parameters[name]
        written = marker(parameter, Written)
        is_path = isinstance(value, str | os.PathLike)
        if written is None:
            paths.inputs.extend(_paths_in(value))
            if is_path and marker(parameter, Labelled) is not None:
                # Path.rglob would raise where a folder may not be entered.
                for folder, _, names in os.walk(value):
                    below = (Path(folder, each) for each in names)
                    paths.inputs.extend(path for path in below if path.suffix.lower() in LABELS)
        # Anything else is refused afterwards, when older verdicts are deleted.
        elif is_path:
            # An output that is no folder is the file itself.
            holds = marker(parameter, Holds) or Holds("")
            files = [Path(value) / file for file in holds.files]
            second = marker(parameter, NextTo)
            if second is not None and arguments.get(second.when):
                files.append(Path(value).with_suffix(second.suffix))
            paths.outputs.extend(files)
            paths.folders.extend(Path(value) / folder for folder in holds.folders)
            if written.verdict:
                paths.verdicts.extend(files)
    return paths


def delete_older(function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Delete older verdicts of a verb."""
    from beers_deploy.model.io.files import require_writable

    paths = paths_of(function, arguments)
    for path in paths.verdicts:
        # Files that may not be written are refused afterwards, when all verdicts are deleted.
        with suppress(BeersError):
            require_writable(path, inputs=paths.inputs)
            path.unlink(missing_ok=True)


def require_apart(
    function: Callable[..., Any], arguments: Mapping[str, Any], *more: Path | None
) -> None:
    """Raise an error if an output of a verb cannot be written, or is an input or another output.

    Args:
        function: the verb.
        arguments: its parameters by name.
        more: further outputs.
    """
    from beers_deploy.model.io.files import require_writable

    paths = paths_of(function, arguments)
    outputs = [*paths.outputs, *more]
    if outputs:
        require_writable(*outputs, inputs=paths.inputs, folders=paths.folders)


def _paths_in(value: Any) -> list[Path]:
    """Return the paths of an argument; a shipped name is a path that does not exist.

    Text may hold several with commas, BAND=PATH and PATH@SENSOR. A folder of pairs has its images
    in two folders.
    """
    several = value if isinstance(value, list | tuple) else [value]
    names: list[str | os.PathLike[str]] = []
    for each in several:
        if isinstance(each, str):
            names += [each, *re.split("[,=]", each), *re.split("[,=@]", each)]
        elif isinstance(each, os.PathLike):
            names.append(each)
    paths = [Path(name) for name in names if name != ""]
    roles = (path / role for path, role in product(paths, ("degraded", "reference")))
    # Path.is_dir would raise where a folder may not be entered.
    return [*paths, *filter(os.path.isdir, roles)]


LABELS = {".xml", ".txt"}
"""Suffixes of labels, which lie anywhere below the folder of images: no output may replace one."""


Marker = TypeVar("Marker")


def marker(parameter: Parameter, kind: type[Marker]) -> Marker | None:
    """Return the marker of a type in a parameter's annotation, such as its `Interval`."""
    parts = parts_of(parameter.annotation)
    return next((part for part in parts if isinstance(part, kind)), None)


def parts_of(annotation: Any) -> Iterator[Any]:
    """Yield an annotation, and all that its unions and `Annotated` are made of."""
    yield annotation
    if get_origin(annotation) is not Literal:
        for part in get_args(annotation):
            yield from parts_of(part)


def path_or_none(value: InputPath | None) -> Path | None:
    """Return the path that a parameter names, or None if it is not given."""
    return None if value is None else Path(value)


def changed(
    function: Callable[..., Any], values: Mapping[str, Any], *names: str
) -> dict[str, bool]:
    """Compare the values of some parameters with their defaults.

    Args:
        function: the verb.
        values: the values of its parameters, by name.
        names: the names of the parameters to compare.

    Returns:
        True for each parameter that has another value than its default, by name.
    """
    parameters = signature(function).parameters
    different = {}
    for name in names:
        value = values[name]
        default = parameters[name].default
        # An array is never a default, and would be compared element by element.
        is_plain = isinstance(value, str | Real | Path | Sequence | Mapping)
        different[name] = value is not default and not (is_plain and bool(value == default))
    return different


def refuse_with(other: str, **options: bool) -> None:
    """Raise OptionError for the first option that is given although it has no effect with another.

    Args:
        other: the other option, in backquotes, with its value where that matters.
        options: True for each option that is given, by its name.
    """
    for name, is_set in options.items():
        if is_set:
            raise OptionError(f"`{name}` has no effect with {other}. Leave one of the two out.")


def refuse_without(other: str, **options: bool) -> None:
    """Raise OptionError for the first option that is given although it needs another.

    Args:
        other: the other option, in backquotes.
        options: True for each option that is given, by its name.
    """
    for name, is_set in options.items():
        if is_set:
            raise OptionError(
                f"`{name}` has no effect without {other}. Add {other}, or leave `{name}` out."
            )


def recorded(arguments: Mapping[str, object]) -> dict[str, object]:
    """Return arguments as a results document has them: numbers, text, or the names of values, of
    those that decide a figure.
    """
    return {name: _recorded(v) for name, v in arguments.items() if name not in NOT_RECORDED}


def _recorded(value: object) -> object:
    if isinstance(value, str | int | float | bool | type(None)):
        return value
    # JSON cannot represent NumPy's numbers.
    if isinstance(value, Real):
        return float(value)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return ", ".join(map(str, value))
    if isinstance(value, list | tuple):
        return ", ".join(str(_recorded(each)) for each in value)
    # A network, a sensor or a board has a name; arrays have none.
    name = getattr(value, "name", None)
    return name if isinstance(name, str) else IN_MEMORY


IN_MEMORY = "in memory"
"""The name of arrays and other values without a name in a document."""
