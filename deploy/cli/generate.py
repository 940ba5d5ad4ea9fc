"""A command of Typer from a verb's signature and docstring.

- A positional parameter is an argument, a keyword-only one an option.
- The text of an argument or option is that of the docstring's `Args`.
- The type is that of the annotation; a type that only Python has is read as text.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from docstring_parser import Docstring, DocstringStyle, parse

from beers_deploy.verbs.parameters import Completed, Interval, PythonOnly, Written
from beers_deploy.verbs.verb import marker, parts_of

Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print errors alone.")]
Verbose = Annotated[
    bool,
    typer.Option("-v", "--verbose", help="Print details too, and where an error arose."),
]
Json = Annotated[
    Path | None, typer.Option(help="Write the results here as JSON; - is standard output.")
]


@dataclass(frozen=True)
class Command:
    """A verb, a public function of this package, described as a command.

    Attributes:
        verb: the function.
        example: an example of its arguments on a command line, which the help shows.
    """

    verb: Callable[..., Any]
    example: str

    @property
    def name(self) -> str:
        """The name of the command, which is that of the function."""
        return self.verb.__name__

    @cached_property
    def doc(self) -> Docstring:
        """The parsed docstring of the function."""
        return parse(inspect.cleandoc(self.verb.__doc__ or ""), DocstringStyle.GOOGLE)

    @property
    def parameters(self) -> list[inspect.Parameter]:
        """The parameters of the function that the command has as arguments or options.

        Those marked `PythonOnly` are left out.
        """
        every = parameters_of(self.verb).values()
        return [parameter for parameter in every if marker(parameter, PythonOnly) is None]

    @property
    def has_table(self) -> bool:
        """True if the command has the option --json: its function does not return a path."""
        return inspect.signature(self.verb).return_annotation is not Path

    @property
    def help(self) -> str:
        """The text of the help above the options: the docstring without its sections."""
        # Without a long description the parser leaves an empty line after the short one.
        return (self.doc.description or "").strip()


@lru_cache
def parameters_of(verb: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """Return the parameters of a verb by name, in the order of its signature."""
    return inspect.signature(verb).parameters


def generated(command: Command, run: Callable[..., None]) -> Callable[..., None]:
    """Make a function from a verb that Typer can turn into a command.

    Args:
        command: the verb and its docstring.
        run: the function that runs the verb. It is called with the parsed options as keyword
            arguments, and with quiet, verbose and, if the command has a table, json.

    Returns:
        A function whose signature has Typer's annotations, and whose docstring is the help.
    """

    def called(**options: Any) -> None:
        run(**options)

    texts = {entry.arg_name: entry.description or "" for entry in command.doc.params}
    parameters = [
        _for_typer(parameter, text_for_command(texts[parameter.name], command.verb))
        for parameter in command.parameters
    ]
    if command.has_table:
        parameters.append(_keyword("json", Json, None))
    parameters += [_keyword("quiet", Quiet, False), _keyword("verbose", Verbose, False)]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    called.__doc__ = in_options(command.help, command.verb)
    return called


def _keyword(name: str, hint: Any, default: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=hint)


def _for_typer(parameter: inspect.Parameter, text: str) -> inspect.Parameter:
    """Return a parameter with the annotation and the default that Typer reads."""
    about: dict[str, Any] = {"help": text}
    interval = marker(parameter, Interval)
    if interval is not None:
        about |= {"min": interval.ge, "max": interval.le}
    completed = marker(parameter, Completed)
    if completed is not None:
        about["autocompletion"] = _completion(completed)
        if completed.listed:
            about["help"] += f" Names: {', '.join(completed.names())}."
    hint, repeated = read_as(parameter.annotation)
    default = _default(parameter, hint, repeated)
    if repeated:
        hint = list[hint]  # type: ignore[valid-type]
    if default is None:
        hint = hint | None
    if parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
        info = typer.Argument(metavar=metavar_of(parameter), **about)
    else:
        info = typer.Option(*spellings_of(parameter), **about)
    return _keyword(parameter.name, Annotated[hint, info], default)


def _default(parameter: inspect.Parameter, hint: Any, repeated: bool) -> Any:
    """Return the default on the command line, or the empty default if the parameter is required."""
    written = marker(parameter, Written)
    if written is not None and written.required:
        return inspect.Parameter.empty
    if parameter.default is parameter.empty or parameter.default is None:
        return parameter.default
    if repeated:
        return None
    return str(parameter.default) if hint is str else parameter.default


def read_as(annotation: Any) -> tuple[Any, bool]:
    """Find the type to which the command line converts the text of a parameter.

    Args:
        annotation: the annotation of the parameter. If it is a union with types that only Python
            has, such as a mapping of limits, its first type for the command line is used.

    Returns:
        A Literal, bool, int, float, str or Path; and True if the option may be repeated, because
        the annotation is a sequence of this type.

    Raises:
        TypeError: the annotation contains no type for the command line.
    """
    parts = list(parts_of(annotation))
    repeated = next((part for part in parts if get_origin(part) is Sequence), None)
    if repeated is not None:
        return read_as(get_args(repeated)[0])[0], True
    for part in parts:
        if get_origin(part) is Literal or part in (bool, int, float, str, Path):
            return part, False
    raise TypeError(f"the command line cannot read {annotation}")


def spellings_of(parameter: inspect.Parameter) -> list[str]:
    """Return the spellings of an option in Typer's notation, such as ["-o", "--out"].

    A switch that is on by default is spelt "--name/--no-name".
    """
    name = option_of(parameter.name)
    if parameter.default is True:
        return [f"{name}/--no-{name[2:]}"]
    if parameter.name == "out":
        return ["-o", name]
    return [name]


def option_of(name: str) -> str:
    """Return the option of a parameter name: `max_mae` becomes --max-mae, and `with_` --with."""
    return f"--{name.rstrip('_').replace('_', '-')}"


def metavar_of(parameter: inspect.Parameter) -> str:
    """Return the name of a positional argument in the help: that of the parameter in capitals."""
    return parameter.name.upper()


def _completion(completed: Completed) -> Callable[[str], list[str]]:
    """Return a function that completes names, and paths if no name fits."""

    def complete(incomplete: str) -> list[str]:
        # Several names are separated by commas.
        before, comma, last = incomplete.rpartition(",")
        names = [name for name in completed.names() if name.startswith(last)]
        folder = Path(last).parent
        if not names and folder.is_dir():
            paths = [str(path) for path in folder.iterdir()]
            names = [path for path in paths if path.startswith(last)]
        return [f"{before}{comma}{name}" for name in names]

    return complete


PYTHON_SENTENCE = re.compile(r"\s*(?:\bIn Python\b[^.]*\.|; in Python\b[^.;]*)")
"""A sentence, or a part after a semicolon, that describes what Python accepts too."""


def text_for_command(text: str, verb: Callable[..., Any]) -> str:
    """Convert the docstring text of a parameter to its help text.

    Args:
        text: the text under Args. Sentences on what only Python accepts are removed.
        verb: the function, whose parameter names are replaced by options.

    Returns:
        One line that begins with a capital.
    """
    words = in_options(PYTHON_SENTENCE.sub("", " ".join(text.split())).strip(), verb)
    return words[:1].upper() + words[1:]


def in_options(text: str, verb: Callable[..., Any]) -> str:
    """Replace parameter names in a text by the options of the command line.

    Messages and docstrings name a parameter in backquotes, as Python has it: `max_mae` becomes
    --max-mae here, and a positional parameter becomes its name in capitals.

    Args:
        text: the text.
        verb: the function that has the parameters. Other names in backquotes lose the backquotes.
    """
    parameters = parameters_of(verb)

    def named(match: re.Match[str]) -> str:
        parameter = parameters.get(match[1])
        if parameter is None:
            return match[1]
        if parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
            return metavar_of(parameter)
        # A switch that is on by default is written only to turn it off.
        return spellings_of(parameter)[-1].rpartition("/")[2]

    return re.sub(r"`(\w+)`", named, text)
