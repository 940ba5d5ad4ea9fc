"""One rule for every output of every command: no input, no other output, nothing but a regular file
or a new name.

docs/make/options.py says of every path that a command takes whether it is read or written.
"""

import os
import socket
import stat
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, combinations, cycle
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from beers_deploy.cli import COMMANDS, app
from docs.make.options import FILE, PATHS

INSIDE = {
    "demo": "int8.onnx",
    "simulate": "recipe.json",
    "train": "checkpoint.safetensors",
    "quantize": "report.html",
    "gate": "record.json",
    "golden": "golden.json",
    "evaluate": "report.html",
    "detect": "report.html",
    "tradeoff": "tradeoff.html",
}
"""A file that a command writes into its output folders."""
SUFFIXES = {"check": ".svg"}
"""Of every name, where a command asks for one."""
MORE = {"stress": ("--bit-flips",), "tradeoff": ("--network", "convbeers-xs")}
"""Without which a command does not write, or computes for seconds before it looks at its images."""
BESIDE = {
    ("restore", "sensor"): ("--method", "traditional"),
    ("train", "rounding"): ("--conditioned", "--start", "convbeers-xs"),
    ("detect", "labels"): ("--images", "pictures"),
    ("tradeoff", "detector"): ("--labelled", "pictures"),
}
"""What an option is refused without."""


def outputs_of_commands() -> Iterator[tuple[str, str]]:
    """Yield every command with each option that names an output."""
    for name, paths in PATHS.items():
        for option in paths.written:
            yield name, option


WRITERS = list(outputs_of_commands())
TELLS_CI = ("gate", "junit")
"""What is written where nothing could be judged, too: a CI job then shows why."""
FILES = [(name, option) for name, option in WRITERS if PATHS[name].written[option] == FILE]
FOLDERS = [pair for pair in WRITERS if pair not in FILES]


def in_turn(cases: Iterable[tuple[str, ...]], ways: Iterable[object]) -> list[tuple[object, ...]]:
    """Each case one way, each way in its turn: one function looks at the
    outputs of all commands.
    """
    return [(*case, way) for case, way in zip(cases, cycle(ways), strict=False)]


def suffix_of(name: str) -> str:
    return SUFFIXES.get(name, ".tif")


def parameters(command: str) -> dict[str, Any]:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    return {str(parameter.name): parameter for parameter in group.commands[command].params}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_path_of_a_command_is_known_to_be_read_or_written(name: str) -> None:
    hints = get_type_hints(COMMANDS[name][0]).items()
    paths = {option for option, hint in hints if "Path" in str(hint)}
    assert paths == {*PATHS[name].written, *PATHS[name].read}
    assert set(PATHS[name].also_read) <= set(parameters(name))


def arguments(name: str, values: dict[str, Path]) -> list[str]:
    """The command with these values; arguments that it cannot do without get files that exist."""
    options = list[str]()
    positional = list[str]()
    for key, parameter in parameters(name).items():
        value = values.get(key)
        if parameter.param_type_name == "argument":
            positional += [str(value)] if value else []
        elif value is not None:
            options += [parameter.opts[0], str(value)]
    more = chain.from_iterable(BESIDE.get((name, option), ()) for option in values)
    return [name, *MORE.get(name, ()), *positional, *options, *more]


def command_with(name: str, folder: Path, **values: Path) -> list[str]:
    """As `arguments`: an input for each argument, an output for each that must be given, unless
    told otherwise.
    """
    paths = PATHS[name]
    all_values = dict(values)
    for key, parameter in parameters(name).items():
        if key in all_values:
            continue
        if parameter.param_type_name == "argument" and key in paths.read:
            all_values[key] = existing(folder / f"input-{key}{suffix_of(name)}")
        elif key in paths.written and parameter.required:
            all_values[key] = folder / f"output-{key}{suffix_of(name)}"
    return arguments(name, all_values)


def existing(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"what was in {path.name}")
    return path


def output_at(name: str, option: str, folder: Path) -> tuple[Path, Path]:
    """An option's value, and the file that the command will write for it."""
    if (name, option) in FILES:
        path = folder / f"place-{option}{suffix_of(name)}"
        return path, path
    return folder / f"place-{option}", folder / f"place-{option}" / INSIDE[name]


def state(folder: Path) -> dict[str, bytes | str]:
    """Every entry: bytes of files, kinds of others."""
    entries: dict[str, bytes | str] = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            entries[str(path.relative_to(folder))] = path.read_bytes()
        else:
            entries[str(path.relative_to(folder))] = f"kind {stat.S_IFMT(mode)}"
    return entries


def refused(command: list[str], folder: Path, *words: str) -> None:
    before = state(folder)
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2, (command, result.output)
    assert result.stderr.startswith("beers-deploy: "), result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
    for word in words:
        assert word in result.stderr, (command, result.stderr)
    assert state(folder) == before, command


def pipe(path: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("this system makes no pipes")
    os.mkfifo(path)


def device(path: Path) -> None:
    try:
        os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 3))
    except (AttributeError, OSError):
        pytest.skip("only an administrator can make a device")


def link(path: Path) -> None:
    try:
        path.symlink_to(existing(path.parent / "linked-to"))
    except OSError:
        pytest.skip("this account cannot make links")


def dangling(path: Path) -> None:
    try:
        path.symlink_to(path.parent / "nothing-there")
    except OSError:
        pytest.skip("this account cannot make links")


STANDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a folder": (Path.mkdir, "a folder"),
    "a link": (link, "a symbolic link"),
    "a link to nothing": (dangling, "a symbolic link"),
    "a pipe": (pipe, "no regular file"),
    "a device": (device, "no regular file"),
}


@pytest.mark.parametrize(("name", "option", "kind"), in_turn(WRITERS, STANDS))
def test_only_a_regular_file_is_written_over(
    name: str, option: str, kind: str, tmp_path: Path
) -> None:
    value, file = output_at(name, option, tmp_path)
    file.parent.mkdir(parents=True, exist_ok=True)
    make, word = STANDS[kind]
    make(file)
    refused(command_with(name, tmp_path, **{option: value}), tmp_path, str(file), word)


@pytest.mark.parametrize(
    ("name", "option", "make"), in_turn(FOLDERS, [existing, pipe, device, dangling])
)
def test_an_output_folder_is_a_folder(
    name: str, option: str, make: Callable[[Path], object], tmp_path: Path
) -> None:
    make(tmp_path / "place")
    refused(command_with(name, tmp_path, **{option: tmp_path / "place"}), tmp_path, "place")


@pytest.mark.parametrize(
    ("name", "option"), [pair for pair in WRITERS if pair != TELLS_CI], ids=str
)
def test_what_is_refused_for_its_input_leaves_no_new_folder(
    name: str, option: str, tmp_path: Path
) -> None:
    source = existing(tmp_path / f"source{suffix_of(name)}")
    value, _ = output_at(name, option, tmp_path / "new" / "below")
    command = command_with(name, tmp_path, **{option: value, PATHS[name].read[0]: source})
    before = state(tmp_path)
    assert CliRunner().invoke(app, command).exit_code == 2, command
    assert state(tmp_path) == before, command


def inputs_met() -> Iterator[tuple[str, str, str]]:
    for name, option in WRITERS:
        for source in (*PATHS[name].read, *PATHS[name].also_read):
            yield name, option, source


@pytest.mark.parametrize(
    ("name", "option", "source", "how"),
    in_turn(inputs_met(), ["itself", "symbolic link", "hard link"]),
)
def test_no_output_is_an_input(
    name: str, option: str, source: str, how: str, tmp_path: Path
) -> None:
    value, file = output_at(name, option, tmp_path)
    file.parent.mkdir(parents=True, exist_ok=True)
    source_path = existing(file if how == "itself" else tmp_path / f"source{suffix_of(name)}")
    if how == "symbolic link":
        file.symlink_to(source_path)
    elif how == "hard link":
        file.hardlink_to(source_path)
    command = command_with(name, tmp_path, **{option: value, source: source_path})
    refused(command, tmp_path, str(file), "an input of this run")


FOLDERS_READ = [
    (name, option, source)
    for name, option, source in inputs_met()
    if source in ("images", "pairs", "calibration") and (name, option) in FILES
]


@pytest.mark.parametrize(("name", "option", "source"), FOLDERS_READ)
def test_no_output_is_a_file_of_an_input_folder(
    name: str, option: str, source: str, tmp_path: Path
) -> None:
    scene = existing(
        tmp_path / "scenes" / ("scene.tif" if suffix_of(name) == ".json" else "scene.png")
    )
    if source == "pairs":
        scene = existing(tmp_path / "scenes" / "reference" / "scene.tif")
    command = command_with(name, tmp_path, **{option: scene, source: tmp_path / "scenes"})
    refused(command, tmp_path, str(scene), "an input of this run")


def test_figures_of_an_earlier_run_beside_the_images_are_renewed(tmp_path: Path) -> None:
    """The rule does not stop a job that is run twice: it gets as far as reading the images."""
    existing(tmp_path / "scenes" / "scene.png")
    figures = existing(tmp_path / "scenes" / "figures.json")
    result = CliRunner().invoke(
        app, ["evaluate", "--images", str(figures.parent), "--json", str(figures)]
    )
    assert result.exit_code == 2
    assert "scene.png" in result.stderr


@pytest.mark.parametrize("command", ["evaluate", "simulate"])
def test_pictures_do_not_go_where_images_are_read(command: str, tmp_path: Path) -> None:
    scene = existing(tmp_path / "scenes" / "degraded" / "scene.tif")
    arguments_of = {
        "evaluate": ["--images", str(scene.parent), "--out", str(scene.parent)],
        "simulate": [str(scene), "--out", str(tmp_path / "scenes")],
    }
    refused([command, *arguments_of[command]], tmp_path, "the folder of an input")


def pairs_of_outputs() -> Iterator[tuple[str, str, str]]:
    """Yield every command with each two of its outputs."""
    for name, paths in PATHS.items():
        for one, other in combinations(paths.written, 2):
            yield name, one, other


@pytest.mark.parametrize(("name", "one", "other"), list(pairs_of_outputs()))
def test_no_two_outputs_are_one(name: str, one: str, other: str, tmp_path: Path) -> None:
    value, file = output_at(name, one, tmp_path)
    if (name, other) in FOLDERS:
        value, file = output_at(name, other, tmp_path)
        one, other = other, one
    words = str(tmp_path), "another output"
    refused(command_with(name, tmp_path, **{one: value, other: file}), tmp_path, *words)
    (tmp_path / "detour").mkdir(exist_ok=True)
    around = tmp_path / "detour" / ".." / file.relative_to(tmp_path)
    refused(command_with(name, tmp_path, **{one: value, other: around}), tmp_path, *words)


def test_the_curves_of_bit_flips_are_an_output_too(tmp_path: Path) -> None:
    core = existing(tmp_path / "curves.svg")
    command = ["stress", "--bit-flips", str(core), str(core), "--out", str(tmp_path / "curves.md")]
    refused(command, tmp_path, "curves.svg", "an input of this run")


def test_a_socket_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(socket, "AF_UNIX"):
        pytest.skip("this system has no such sockets")
    # The path of a socket must be short, so the name is relative.
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("figures.json")
        refused(["bench", "--json", "figures.json"], tmp_path, "no regular file")
