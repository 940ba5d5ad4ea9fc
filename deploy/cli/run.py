"""Run a verb as a command: print its result, and map errors to exit codes."""

import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import replace
from errno import EDQUOT, EFBIG, ENOENT, ENOSPC
from pathlib import Path
from typing import Any

import typer

from beers_deploy.cli.generate import Command, in_options
from beers_deploy.cli.streams import STDOUT, delete_results, save_results
from beers_deploy.model.progress import live_console, reporting
from beers_deploy.profiles.errors import (
    CRASHED,
    BeersError,
    OptionError,
    missing_extra,
    one_line,
    visible,
)
from beers_deploy.verbs.parameters import RequiredUnless
from beers_deploy.verbs.verb import delete_older, marker, paths_of, require_apart

INTERRUPTED = 130
"""Exit code of Ctrl-C."""


def run(
    command: Command,
    *,
    quiet: bool = False,
    verbose: bool = False,
    json: Path | None = None,
    **options: Any,
) -> None:
    """Run a verb as a command, and print its result.

    Args:
        command: the verb.
        quiet: True to print only errors.
        verbose: True to print details too, and the traceback of an error.
        json: the file to write the results document to; "-" for standard output; None for neither.
        options: the arguments of the verb, None where the user gave none.

    Raises:
        typer.Exit: the exit code is 1 if a check failed, 2 for an error that the user can correct,
            130 after Ctrl-C, and 70 for a fault of the program.
    """
    try:
        with reporting(False if quiet else None), logged(command, quiet, verbose):
            result = _result(command, options, json)
            _show(result, command, quiet, verbose)
            table = table_of(result)
            if table is not None:
                save_results(table, json)
    except (typer.Exit, typer.Abort):
        raise
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - no fault must look like a failed gate
        message, code = ending(error, command)
        if isinstance(error, BeersError) and options.get("junit") not in (None, STDOUT):
            from beers_deploy.model.io.files import write_text
            from beers_deploy.verdict import junit_error

            # A refused output path gets no file.
            with suppress(BeersError):
                require_apart(command.verb, _arguments(options), json)
                write_text(options["junit"], junit_error("INT8 gate", message))
        if verbose or code == CRASHED:
            traceback.print_exc()
        typer.echo(f"beers-deploy: {visible(message)}", err=True)
        raise typer.Exit(code) from None
    if table is not None and not table:
        if quiet:
            verdict = in_options(table.verdict, command.verb)
            typer.echo(f"beers-deploy: {one_line(verdict)}", err=True)
        raise typer.Exit(1)


def _arguments(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that are on the command line or have a default."""
    return {name: value for name, value in options.items() if value not in (None, [])}


def _result(command: Command, options: dict[str, Any], json: Path | None) -> Any:
    """Call the verb with the options that are given."""
    arguments = _arguments(options)
    for parameter in command.parameters:
        needed = marker(parameter, RequiredUnless)
        if needed and parameter.name not in arguments and not arguments.get(needed.other):
            raise OptionError(f"`{parameter.name}` is missing. Give it, or add `{needed.other}`.")
    if json is not None and json != STDOUT:
        delete_older(command.verb, arguments)
        delete_results(json, paths_of(command.verb, arguments).inputs)
        require_apart(command.verb, arguments, json)
    result = command.verb(**arguments)
    if json is not None and isinstance(result, str):
        raise OptionError("--json has no effect with --toml. Leave one of the two out.")
    return result


def table_of(result: Any) -> Any:
    """Return the table to print for the result of a verb.

    Args:
        result: the result of the verb: a `Table`, or a value such as a `Network`.

    Returns:
        The table itself, or the attribute `table` of the value; None if there is neither.
    """
    from beers_deploy.results import Table

    return result if isinstance(result, Table) else getattr(result, "table", None)


def _show(result: Any, command: Command, quiet: bool, verbose: bool) -> None:
    """Print a result on standard output."""
    if quiet:
        return
    table = table_of(result)
    if table is not None:
        notes = tuple(in_options(note, command.verb) for note in table.notes)
        rows = []
        for row in table.rows:
            words = {key: in_options(text, command.verb) for key, text in row.text.items()}
            rows.append(replace(row, text=words))
        checks = tuple(
            replace(check, detail=in_options(check.detail, command.verb)) for check in table.checks
        )
        replace(table, notes=notes, rows=tuple(rows), checks=checks).print(details=verbose)
    elif isinstance(result, str):
        # A terminal must obey nothing in the text of a file.
        for line in result.removesuffix("\n").split("\n"):
            typer.echo(one_line(line))


@contextmanager
def logged(command: Command, quiet: bool, verbose: bool) -> Iterator[None]:
    """Print the log messages of this package on standard error within the `with` block.

    Args:
        command: the command, whose options replace parameter names in the messages.
        quiet: True to print only errors; by default information and warnings are printed too.
        verbose: True to print debug messages too, unless `quiet`.
    """
    logger = logging.getLogger("beers_deploy")
    handler = Lines(command)
    before = logger.level, logger.propagate
    level = logging.INFO
    if quiet:
        level = logging.ERROR
    elif verbose:
        level = logging.DEBUG
    handler.setLevel(level)
    logger.setLevel(min(level, logging.INFO))
    logger.propagate = False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate = before[1]


class Lines(logging.Handler):
    """A log handler that prints each record as one line on standard error.

    While a progress bar is shown, the line is printed above the bar.
    """

    def __init__(self, command: Command) -> None:
        super().__init__()
        self._command = command
        self._warned: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record. Warnings are marked as such, and each is printed once."""
        # The names of files that are inserted into a message stay as they are.
        message = copy(record)
        message.msg = in_options(str(record.msg), self._command.verb)
        text = one_line(message.getMessage())
        if record.levelno >= logging.WARNING:
            # Several networks of one sensor warn of the same.
            if text in self._warned:
                return
            self._warned.add(text)
            text = f"warning: {text}"
        console = live_console()
        if console is None:
            sys.stderr.write(f"{text}\n")
        else:
            console.print(text, markup=False, highlight=False, soft_wrap=True)


def ending(error: BaseException, command: Command) -> tuple[str, int]:
    """Map an error that ends a command to a message for the user and an exit code.

    Args:
        error: the error. One that is no `BeersError` is a fault of the program or of a library,
            except lack of memory, a missing library and Ctrl-C.
        command: the command, whose options replace parameter names in the message.

    Returns:
        The message in one line, and 2 for an error that the user can correct, 130 for Ctrl-C, or
        70 for a fault.
    """
    if isinstance(error, ImportError) and not isinstance(error, BeersError):
        error = missing_extra(error, command.name)
    if isinstance(error, BeersError):
        return in_options(str(error), command.verb), 2
    if isinstance(error, MemoryError):
        return "There is not enough memory for this input. Give a smaller image or tile.", 2
    # Of all calls of the system, only the one that asks for the working folder names no file.
    if isinstance(error, OSError) and error.errno == ENOENT and error.filename is None:
        return "The working folder was deleted. Change to another folder, and run this again.", 2
    if isinstance(error, OSError) and error.errno in (ENOSPC, EDQUOT, EFBIG):
        where = error.filename or "an output"
        return f"There is no space to write {where}: {error.strerror}. Free some of the disk.", 2
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", INTERRUPTED
    at_fault = " or of ".join(["this program", *_library_of(error)])
    return f"This is a fault of {at_fault}. Please report it: {error!r}", CRASHED


def _library_of(error: BaseException) -> list[str]:
    """Return the name and version of the library that raised an error, or nothing if this program
    raised it.
    """
    from importlib.metadata import packages_distributions, version

    distributions = packages_distributions()
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package == __package__.partition(".")[0]:
            return []
        # The standard library belongs to no distribution.
        if package in distributions:
            name = distributions[package][0]
            return [f"{name} {version(name)}"]
    return []
