"""Define the exceptions for bad input.

BeersError              one sentence, no traceback, exit code 2
  ProfileError          a sensor or target profile
  ImageError            a scene or an acquisition
  ModelError            a weights or ONNX file
  OptionError           a parameter's value, or two that do not go together
  MachineError          the host: memory, disk
    MissingExtraError        an optional package

Each is also the built-in exception that a caller expects: ValueError, RuntimeError, ImportError.

A gate that fails is no error: its command exits with 1.
"""

import os
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from traceback import walk_tb
from typing import Any

CRASHED = 70
"""Exit code of a fault in this program or its installation (sysexits' EX_SOFTWARE)."""

LONGEST = 400
"""The maximum number of characters from a file that a message shows."""

LONGEST_MESSAGE = 2400
"""The maximum number of characters of a whole message."""


class BeersError(Exception):
    """Bad input, with a message for the person who gave it.

    Args:
        message: a sentence on what is wrong, with the value and the file or the parameter, and one
            on what to do. Names of parameters stand in backquotes: the command line replaces them
            by its options.

    Examples:
        >>> try:
        ...     bd.Board.load("my-board")
        ... except bd.BeersError as error:
        ...     print(type(error).__name__)
        ProfileError
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message, LONGEST_MESSAGE))


def printable(text: str, longest: int = LONGEST) -> str:
    """Return text from an untrusted file as one line that is safe to print, cut after `longest`
    characters and then followed by "...".
    """
    return one_line(text[:longest]) + ("..." if len(text) > longest else "")


def reason_of(error: BaseException) -> str:
    """Return the message of a library's error on one line, shortened and without a full stop, for
    use in a sentence.
    """
    return printable(" ".join(str(error).split())).rstrip(".")


def one_line(text: str) -> str:
    """Return the whole text on one line, with Python's escape in place of each character that is
    not printable.

    Among these are line breaks, control characters, and those that change the direction of writing:
    a name from a file must not look like another line of a log.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def encodable(text: str) -> str:
    """Return the text with a backslash escape for each character that UTF-8 cannot encode; file
    names in another encoding have such characters.
    """
    return text.encode(errors="backslashreplace").decode()


def visible(text: str) -> str:
    """Return the text with line breaks and tabs unchanged, and every other unprintable character
    replaced by its Python escape.
    """
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


def sizes(*counts_bytes: float) -> list[str]:
    """Format numbers of bytes as text, each in its own unit: GB, MB, kB or bytes.

    All have the same number of significant digits, three or more, so that different numbers give
    different texts.

    Returns:
        One text for each number, in the same order.
    """
    for digits in range(3, 17):
        texts = [_size(count, digits) for count in counts_bytes]
        if len(set(texts)) == len(set(counts_bytes)):
            break
    return texts


def counted(count: int, name: str) -> str:
    """Return a count and a noun, such as "3 pixels". The noun has an "s" unless the count is 1."""
    return f"{count} {name}{'' if count == 1 else 's'}"


def _size(count_bytes: float, digits: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count_bytes >= scale:
            value = count_bytes / scale
            return f"{value:.{max(digits - len(str(int(value))), 0)}f} {unit}"
    return f"{count_bytes:.0f} bytes"


class ProfileError(BeersError, ValueError):
    """A sensor or target profile whose contents are missing, wrong or contradictory."""


class ImageError(BeersError, ValueError):
    """An image that cannot be read, or whose pixels make no sense."""


class ModelError(BeersError, ValueError):
    """A weights or ONNX file that the command cannot use."""


class OptionError(BeersError, ValueError):
    """A value of a parameter that is out of range, or two that contradict each other."""


def as_path(value: str | os.PathLike[str]) -> Path:
    """Return the path of an output, or raise OptionError if the value is none."""
    if not isinstance(value, str | os.PathLike):
        raise OptionError(f"The output must be a path, got {printable(repr(value))}. Name it.")
    return Path(value)


def listed(value: Any) -> list[Any]:
    """Return the values of an option that may have several: text with commas between them, a
    sequence, or a single value.
    """
    if isinstance(value, str):
        return [part.strip() for part in value.split(",")]
    return list(value) if isinstance(value, Iterable) else [value]


def require_numbers(name: str, value: object) -> None:
    """Raise ImageError if a text, a path or None is in the place of numbers.

    Args:
        name: the name of the parameter, for the message.
        value: the value. NumPy judges anything but a text, a path and None.
    """
    if value is None or isinstance(value, str | bytes | os.PathLike):
        raise ImageError(
            f"`{name}` must be numbers or an array, got {printable(repr(value))}. Read the file "
            "first."
        )


class MachineError(BeersError, RuntimeError):
    """The computer on which the command runs lacks a resource: memory, disk space or workers."""


class MissingExtraError(MachineError, ImportError):
    """An optional package is not installed or does not load. The message names the extra that
    installs it.
    """


CODE_FAULTS = (AttributeError, ImportError, NameError, TypeError)
"""The exceptions that code raises if it does not fit the version of a library.

A damaged file makes a compiled library raise none of them. A library written in Python may raise
them for both reasons.
"""


EXTRAS = {
    "cyclonedx": "record",
    "distributed": "dask",
    "matplotlib": "study",
    "openvino": "openvino",
    "pandas": "notebook",
    "pycocotools": "study",
    "pystac": "stac",
    "skimage": "study",
    "torch": "torch",
}
"""The extra of beers-deploy that installs a package."""


def optional(package: str, where: str) -> Any:
    """Import an optional package and return its module.

    Args:
        package: the name of the module to import, whose first part is a key of `EXTRAS`.
        where: the parameter or function of this library that needs the package, for the message.

    Raises:
        MissingExtraError: the package is not installed, or does not load.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise _without(package.split(".")[0], where, error) from error


def missing_extra(error: ImportError, where: str) -> Exception:
    """Return the error to raise in place of an ImportError.

    Args:
        error: the error that an import raised.
        where: the parameter or function of this library that needed the import, for the message.

    Returns:
        A `MissingExtraError` that names the extra to install, if an optional package is missing or
        does not load; otherwise `error` itself.
    """
    # The package whose import failed, by the module's name or by the code that imported it. Python
    # runs the top level of a module under this name. An ImportError within a function is no failed
    # import.
    at_import = (
        frame for frame, _ in walk_tb(error.__traceback__) if frame.f_code.co_name == "<module>"
    )
    names = (error.name, *(frame.f_globals.get("__name__") for frame in at_import))
    for name in names:
        package = str(name).partition(".")[0]
        if package in EXTRAS:
            return _without(package, where, error)
    return error


def _without(package: str, where: str, error: ImportError) -> MissingExtraError:
    fault = "is not installed" if error.name == package else f"does not load ({error})"
    return MissingExtraError(
        f"`{where}` needs the package {package}, which {fault}. Run "
        f"pip install 'beers-deploy[{EXTRAS[package]}]'."
    )
