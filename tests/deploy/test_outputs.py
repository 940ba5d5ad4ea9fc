"""One rule for every output of every command: no input, no other output, nothing but a regular file or a new name.

docs/make/options.py says of every path that a command takes whether it is read or written.
"""

import os
import socket
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from deploy.cli import COMMANDS, app
from docs.make.options import FILE, FOLDER, PATHS, Paths
from model.io import files


@dataclass(frozen=True)
class Case:
    """How a command's paths are tried.

    Attributes:
        paths: which are read, and which written.
        inside: a file that the command writes into its output folders.
        suffix: of every name, where the command asks for one.
        more: arguments without which the command does not write.
    """

    paths: Paths
    inside: str = ""
    suffix: str = ".tif"
    more: tuple[str, ...] = ()

    @property
    def written(self) -> dict[str, str]:
        return self.paths.written

    @property
    def read(self) -> tuple[str, ...]:
        return self.paths.read

    @property
    def also_read(self) -> tuple[str, ...]:
        return self.paths.also_read


INSIDE = {
    "demo": "int8.onnx",
    "simulate": "recipe.json",
    "train": "checkpoint.safetensors",
    "quantize": "report.html",
    "evaluate": "report.html",
    "detect": "report.html",
    "tradeoff": "tradeoff.html",
}
SUFFIXES = {"check": ".svg", "compare": ".json"}
MORE = {"stress": ("--bit-flips",)}
BESIDE = {
    ("restore", "sensor"): ("--method", "traditional"),
    ("detect", "labels"): ("--images", "pictures"),
    ("tradeoff", "detector"): ("--labelled", "pictures"),
}
"""What an option is refused without."""
CASES = {
    name: Case(paths, INSIDE.get(name, ""), SUFFIXES.get(name, ".tif"), MORE.get(name, ()))
    for name, paths in PATHS.items()
}
WRITERS = [(name, option) for name, case in CASES.items() for option in case.written]


def parameters(command: str) -> dict[str, Any]:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    return {str(parameter.name): parameter for parameter in group.commands[command].params}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_path_of_a_command_is_known_to_be_read_or_written(name: str) -> None:
    hints = get_type_hints(COMMANDS[name][0]).items()
    paths = {option for option, hint in hints if "Path" in str(hint)}
    assert paths == {*CASES[name].written, *CASES[name].read}
    assert set(CASES[name].also_read) <= set(parameters(name))


def arguments(name: str, values: dict[str, Path]) -> list[str]:
    """The command with these values; arguments that it cannot do without get files that exist."""
    case, options, positional = CASES[name], [], []
    for key, parameter in parameters(name).items():
        value = values.get(key)
        if parameter.param_type_name == "argument":
            positional += [str(value)] if value else []
        elif value is not None:
            options += [parameter.opts[0], str(value)]
    more = [word for option in values for word in BESIDE.get((name, option), ())]
    return [name, *positional, *options, *case.more, *more]


def given(name: str, folder: Path, **values: Path) -> list[str]:
    """As `arguments`: an input for each argument, an output for each that must be given, unless told otherwise."""
    case, whole = CASES[name], dict(values)
    for key, parameter in parameters(name).items():
        if key in whole:
            continue
        if parameter.param_type_name == "argument" and key in case.read:
            whole[key] = kept(folder / f"input-{key}{case.suffix}")
        elif key in case.written and parameter.required:
            whole[key] = folder / f"output-{key}{case.suffix}"
    return arguments(name, whole)


def kept(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"what was in {path.name}")
    return path


def output_at(name: str, option: str, folder: Path) -> tuple[Path, Path]:
    """An option's value, and the file that the command will write for it."""
    case = CASES[name]
    if case.written[option] == FILE:
        path = folder / f"place-{option}{case.suffix}"
        return path, path
    return folder / f"place-{option}", folder / f"place-{option}" / case.inside


def state(folder: Path) -> dict[str, bytes | str]:
    """Every entry: bytes of files, kinds of others."""
    found: dict[str, bytes | str] = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            found[str(path.relative_to(folder))] = path.read_bytes()
        else:
            found[str(path.relative_to(folder))] = f"kind {stat.S_IFMT(mode)}"
    return found


def refused(command: list[str], folder: Path, *words: str) -> None:
    before = state(folder)
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2, (command, done.output)
    assert done.stderr.startswith("beers-deploy: "), done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr, (command, done.stderr)
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
        path.symlink_to(kept(path.parent / "linked-to"))
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
    "a pipe": (pipe, "a pipe"),
    "a device": (device, "a device"),
}


@pytest.mark.parametrize("what", STANDS)
@pytest.mark.parametrize(("name", "option"), WRITERS)
def test_only_a_regular_file_is_written_over(name: str, option: str, what: str, tmp_path: Path) -> None:
    value, file = output_at(name, option, tmp_path)
    file.parent.mkdir(parents=True, exist_ok=True)
    make, word = STANDS[what]
    make(file)
    refused(given(name, tmp_path, **{option: value}), tmp_path, str(file), word)


@pytest.mark.parametrize(
    ("name", "option"), [pair for pair in WRITERS if CASES[pair[0]].written[pair[1]] == FOLDER], ids=str
)
@pytest.mark.parametrize("make", [kept, pipe, device, dangling])
def test_an_output_folder_is_a_folder(name: str, option: str, make: Callable[[Path], object], tmp_path: Path) -> None:
    make(tmp_path / "place")
    refused(given(name, tmp_path, **{option: tmp_path / "place"}), tmp_path, "place")


@pytest.mark.parametrize(("name", "option"), WRITERS, ids=str)
def test_what_is_refused_for_its_input_leaves_no_new_folder(name: str, option: str, tmp_path: Path) -> None:
    source = kept(tmp_path / f"source{CASES[name].suffix}")
    value, _ = output_at(name, option, tmp_path / "new" / "below")
    command = given(name, tmp_path, **{option: value, CASES[name].read[0]: source})
    before = state(tmp_path)
    assert CliRunner().invoke(app, command).exit_code == 2, command
    assert state(tmp_path) == before, command


def inputs_met() -> Iterator[tuple[str, str, str]]:
    for name, option in WRITERS:
        for source in (*CASES[name].read, *CASES[name].also_read):
            yield name, option, source


@pytest.mark.parametrize("how", ["itself", "symbolic link", "hard link"])
@pytest.mark.parametrize(("name", "option", "source"), list(inputs_met()))
def test_no_output_is_an_input(name: str, option: str, source: str, how: str, tmp_path: Path) -> None:
    value, file = output_at(name, option, tmp_path)
    file.parent.mkdir(parents=True, exist_ok=True)
    source_path = kept(file if how == "itself" else tmp_path / f"source{CASES[name].suffix}")
    if how == "symbolic link":
        file.symlink_to(source_path)
    elif how == "hard link":
        file.hardlink_to(source_path)
    command = given(name, tmp_path, **{option: value, source: source_path})
    refused(command, tmp_path, str(file), "an input of this run")


FOLDERS_READ = [
    (name, option, source)
    for name, option, source in inputs_met()
    if source in ("images", "pairs", "calibration") and CASES[name].written[option] == FILE
]


@pytest.mark.parametrize(("name", "option", "source"), FOLDERS_READ)
def test_no_output_is_a_file_of_an_input_folder(name: str, option: str, source: str, tmp_path: Path) -> None:
    scene = kept(tmp_path / "scenes" / ("scene.tif" if CASES[name].suffix == ".json" else "scene.png"))
    if source == "pairs":
        scene = kept(tmp_path / "scenes" / "reference" / "scene.tif")
    command = given(name, tmp_path, **{option: scene, source: tmp_path / "scenes"})
    refused(command, tmp_path, str(scene), "an input of this run")


def test_figures_of_an_earlier_run_beside_the_images_are_renewed(tmp_path: Path) -> None:
    """The rule does not stop a job that is run twice: it gets as far as reading the images."""
    kept(tmp_path / "scenes" / "scene.png")
    figures = kept(tmp_path / "scenes" / "figures.json")
    done = CliRunner().invoke(app, ["evaluate", "--images", str(figures.parent), "--json", str(figures)])
    assert done.exit_code == 2
    assert "scene.png" in done.stderr


@pytest.mark.parametrize("command", ["evaluate", "simulate"])
def test_pictures_do_not_go_where_images_are_read(command: str, tmp_path: Path) -> None:
    scene = kept(tmp_path / "scenes" / "degraded" / "scene.tif")
    wanted = {
        "evaluate": ["--images", str(scene.parent), "--out", str(scene.parent)],
        "simulate": [str(scene), "--out", str(tmp_path / "scenes")],
    }
    refused([command, *wanted[command]], tmp_path, "the folder of an input")


PAIRS = [(name, one, other) for name, case in CASES.items() for one, other in combinations(case.written, 2)]


@pytest.mark.parametrize(("name", "one", "other"), PAIRS)
def test_no_two_outputs_are_one(name: str, one: str, other: str, tmp_path: Path) -> None:
    value, file = output_at(name, one, tmp_path)
    if CASES[name].written[other] == FOLDER:
        (value, file), (one, other) = output_at(name, other, tmp_path), (other, one)
    words = str(tmp_path), "another output"
    refused(given(name, tmp_path, **{one: value, other: file}), tmp_path, *words)
    (tmp_path / "detour").mkdir(exist_ok=True)
    around = tmp_path / "detour" / ".." / file.relative_to(tmp_path)
    refused(given(name, tmp_path, **{one: value, other: around}), tmp_path, *words)
    refused(given(name, tmp_path, **{one: value, other: file / f"below{CASES[name].suffix}"}), tmp_path, *words)


@pytest.mark.parametrize(
    ("name", "option"), [pair for pair in WRITERS if CASES[pair[0]].written[pair[1]] == FILE], ids=str
)
def test_no_output_is_shipped(name: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that a run reads by its name, or where it is given none."""
    monkeypatch.setattr(files, "SHIPPED", tmp_path / "weights")
    value = kept(tmp_path / "weights" / f"kept{CASES[name].suffix}")
    refused(given(name, tmp_path, **{option: value}), tmp_path, str(value), "a file of this installation")


def test_no_output_is_a_shipped_profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "PROFILES", tmp_path)
    profile = kept(tmp_path / "sensors" / "mine.toml")
    refused(["gate", "--json", str(profile)], tmp_path, str(profile), "a file of this installation")


def test_the_curves_of_bit_flips_are_an_output_too(tmp_path: Path) -> None:
    core = kept(tmp_path / "curves.svg")
    command = ["stress", "--bit-flips", str(core), str(core), "--out", str(tmp_path / "curves.md")]
    refused(command, tmp_path, "curves.svg", "an input of this run")


def test_a_socket_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(socket, "AF_UNIX"):
        pytest.skip("this system has no such sockets")
    monkeypatch.chdir(tmp_path)  # a socket's name is short
    with socket.socket(socket.AF_UNIX) as here:
        here.bind("figures.json")
        refused(["bench", "--json", "figures.json"], tmp_path, "a socket")
