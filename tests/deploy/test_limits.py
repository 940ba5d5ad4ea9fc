"""Test that numbers beyond their limits are refused before any work."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from beers_deploy.cli.commands import COMMANDS
from beers_deploy.model.processor import require_cores
from beers_deploy.profiles.errors import OptionError
from beers_deploy.verbs.parameters import Interval
from beers_deploy.verbs.verb import marker
from tests.deploy.command_line import refused
from tests.deploy.verb_parameters import options

HUGE = str(10**23)


@pytest.mark.parametrize("cores", [1, 2, 16])
def test_threads_and_processes_are_at_most_the_cores(
    cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    for count in (0, 1, cores):
        require_cores("threads", count)
    for count in (-1, cores + 1, 100_000):
        with pytest.raises(
            OptionError, match=f"`threads` must be 0 to {cores}, the cores .* got {count}"
        ):
            require_cores("threads", count)


@pytest.mark.parametrize(
    "command",
    [
        "bench --target host --threads",
        "restore raw.tif out.tif --threads",
        "simulate --out pairs --workers",
    ],
)
def test_a_command_names_the_number_of_cores(command: str, working_folder: Path) -> None:
    (working_folder / "raw.tif").write_bytes(b"not read yet")
    words = command.split()
    assert (
        f"{words[-1]} must be 0 to {os.cpu_count()}, the cores of this machine, got 9999"
        in refused(*words, "9999")
    )
    assert [path.name for path in working_folder.iterdir()] == ["raw.tif"]


@pytest.mark.parametrize("seconds", ["0", "-1", "-0.0", "nan", "inf"])
def test_the_time_of_a_swath_must_be_positive(seconds: str) -> None:
    assert "--within" in refused("bench", "--no-traditional", "--within", seconds)


def bounded_options() -> Iterator[tuple[str, str]]:
    """Yield the command and the label of every option that has a largest value."""
    for name in COMMANDS:
        for option in options(name).values():
            interval = marker(option.parameter, Interval)
            if interval is not None and interval.le is not None:
                yield name, option.label


@pytest.mark.parametrize(("command", "option"), list(bounded_options()))
def test_a_huge_number_is_refused_at_once(command: str, option: str) -> None:
    message = refused(command, option, HUGE)
    assert "less than or equal to" in message
    assert option in message
