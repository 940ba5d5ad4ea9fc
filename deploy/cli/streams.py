"""Standard output and standard error that do not end a run if they break."""

import io
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

from beers_deploy.profiles.errors import OptionError

if TYPE_CHECKING:
    from beers_deploy.results import Table

SCHEMA_NAME = "beers-deploy/results"
"""The same as in `deploy.results`, which is imported late."""

HEAD_BYTES = 200
"""Bytes of a results document in which the name of its schema appears."""

STDOUT = Path("-")
"""The value of --json that stands for standard output. Tables and notes then go to standard
error."""

_results: ContextVar[TextIO | None] = ContextVar("results", default=None)


class Stream:
    """A wrapper of standard output or error in which a failed write does not end the run.

    Text that cannot be written, for example because the disk is full, is dropped. It does not count
    as lost if nobody wants it: the reader of a pipe, such as `head`, has closed it, or the stream
    was already closed when the program started.

    Attributes:
        stream: the wrapped stream.
        lost: the reason why text was lost; empty if none was.
    """

    def __init__(self, stream: Any) -> None:
        self.stream = stream or open(os.devnull, "w")  # noqa: PTH123, SIM115 - as long as the process
        self.lost = ""
        if isinstance(self.stream, io.TextIOWrapper):
            # A name that the terminal cannot show must not end a run either.
            self.stream.reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        """Write the text and flush it, or drop it if that fails, and return its length."""
        if not self.lost:
            try:
                self.stream.write(text)
                self.stream.flush()
            except OSError as error:
                if not isinstance(error, BrokenPipeError):
                    self.lost = error.strerror or str(error)
                # Buffered text must not be tried once more when Python ends.
                with suppress(OSError, ValueError):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())
        return len(text)

    def flush(self) -> None:
        """Do nothing, because each write flushes."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def lasting_streams(results_on_stdout: bool) -> Iterator[Stream]:
    """Replace standard output and error within the `with` block by streams whose failure does not
    end the run.

    Args:
        results_on_stdout: True if standard output is for the results document alone, so that
            everything else that is printed goes to standard error.

    Yields:
        The wrapped standard output, whose `lost` states at the end why text was dropped.
    """
    out = Stream(sys.stdout)
    sys.stdout = cast(TextIO, out)
    sys.stderr = cast(TextIO, Stream(sys.stderr))
    if not results_on_stdout:
        yield out
        return
    token = _results.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield out
    finally:
        _results.reset(token)


def delete_results(path: Path, inputs: Iterable[Path]) -> None:
    """Delete an older results document, so that it is not mistaken for the result of a refused run.

    Args:
        path: the path of the document that will be written.
        inputs: the files that the run reads.

    Raises:
        OptionError: the path is an existing file of another kind. A run may read such a file
            without naming it, for example a tile of an index.
    """
    from beers_deploy.model.io.files import require_writable

    require_writable(path, inputs=inputs)
    if not path.exists():
        return
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if SCHEMA_NAME.encode() not in head:
        raise OptionError(
            f"{path} exists and is not a results document, so it is not replaced. Choose another "
            "path for `json`."
        )
    path.unlink()


def save_results(table: "Table", path: Path | None) -> None:
    """Write a table as a results document to the destination of --json.

    Args:
        table: the table.
        path: the file; "-" for standard output; None to write nothing.

    Raises:
        OptionError: the file is another output of this run, which would be overwritten.
    """
    if path == STDOUT:
        (_results.get() or sys.stdout).write(table.to_json())
    elif path is not None:
        if path.exists():
            raise OptionError(
                f"{path} is another output of this run. Choose another path for `json`."
            )
        table.save(path)
