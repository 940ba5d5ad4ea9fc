"""Test one rule for every output of every command: it is no input, no other output, and either a
regular file or a new name.

The annotation of a parameter states whether its path is read or written, and the files of a folder.
"""

import os
import socket
import stat
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, combinations, cycle, product
from pathlib import Path

import pytest
from typer.testing import CliRunner

from beers_deploy.cli.commands import COMMANDS, app
from beers_deploy.results import Table
from tests.deploy.command_line import done
from tests.deploy.verb_parameters import options

JSON = "json"
SUFFIX = ".onnx"
"""The suffix of every name, because some commands need it."""
MORE = {
    "stress": ("--bit-flips",),
    "tradeoff": ("--network", "convbeers-xs"),
    "simulate": ("--with", "haze"),
}
"""Options without which a command writes nothing, or computes for seconds before it checks."""
BESIDE = {
    ("restore", "sensor"): ("--method", "traditional"),
    ("train", "rounding"): ("--conditioned", "--start", "convbeers-xs"),
    ("evaluate", "labels"): ["--images", "pictures", "--detector", "detector.onnx"],
    ("golden", "network"): (),
}
"""The options that an option needs."""
TOGETHER_REFUSED = {("golden", "compare"), ("export", "apply")}
"""Inputs that are refused with any output."""


def outputs_of(name: str) -> dict[str, str]:
    """Return the outputs of a command: for a folder its first file, for a file an empty text."""
    outputs = {}
    for option in options(name).values():
        if option.written is not None:
            outputs[option.name] = option.holds.files[0] if option.holds else ""
    if COMMANDS[name].has_table:
        outputs[JSON] = ""
    return outputs


def inputs_of(name: str) -> list[str]:
    """Return the names of the inputs of a command."""
    return [option.name for option in options(name).values() if option.is_input]


WRITERS = list(chain.from_iterable(product([name], outputs_of(name)) for name in COMMANDS))
TELLS_CI = ("gate", "junit")
"""An output that is also written after an error, so that a CI job shows the reason."""
FILES = [(name, output) for name, output in WRITERS if not outputs_of(name)[output]]
FOLDERS = [pair for pair in WRITERS if pair not in FILES]


def in_turn(cases: Iterable[tuple[str, ...]], ways: Iterable[object]) -> list[tuple[object, ...]]:
    """Give each case one of the ways in turn: one function checks the outputs of all commands."""
    return [(*case, way) for case, way in zip(cases, cycle(ways), strict=False)]


def test_every_output_folder_declares_its_files() -> None:
    for name in COMMANDS:
        for option in options(name).values():
            if option.written is not None and option.written.folder:
                assert option.holds is not None, (name, option.name)


def arguments(name: str, values: dict[str, Path]) -> list[str]:
    """Return the words of a command with these values."""
    words = [name, *MORE.get(name, ())]
    for key, value in values.items():
        if key == JSON:
            words += ["--json", str(value)]
        else:
            words += options(name)[key].words(value)
        words += BESIDE.get((name, key), ())
    return words


def command_with(command: str, folder: Path, /, **values: Path) -> list[str]:
    """Return the words of a command with `values`, and with the other inputs and outputs that
    it needs.
    """
    all_values: dict[str, Path] = {}
    for key, option in options(command).items():
        if key in values:
            all_values[key] = values[key]
        elif option.is_argument and option.is_input:
            all_values[key] = existing(folder / f"input-{key}{SUFFIX}")
        elif option.written is not None and (option.required or key == "out"):
            all_values[key] = folder / f"output-{key}{SUFFIX}"
    return arguments(command, {**all_values, **values})


def existing(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"what was in {path.name}")
    return path


def output_at(name: str, option: str, folder: Path) -> tuple[Path, Path]:
    """Return a value for an option, and the file that the command will write for it."""
    path = folder / f"place-{option}{SUFFIX}"
    return path, path / outputs_of(name)[option] if outputs_of(name)[option] else path


def state(folder: Path) -> dict[str, bytes | str]:
    """Return every entry of a folder: the bytes of a file, the kind of anything else."""
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
    "a pipe": (pipe, "not a regular file"),
    "a device": (device, "not a regular file"),
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


@pytest.mark.parametrize("url", ["s3://bucket/out.tif", "HTTP://host/out.tif", "/vsis3/out.tif"])
def test_no_output_is_a_url(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folders would be made here, and rasterio would refuse it after the last row."""
    monkeypatch.chdir(tmp_path)
    image = existing(tmp_path / "in.tif")
    before = state(tmp_path)
    for words in (("restore", image, url), ("check", "--json", url)):
        assert "not on this machine" in done(*words, code=2)
    assert state(tmp_path) == before


@pytest.mark.parametrize(("name", "option"), [pair for pair in WRITERS if pair[1] != JSON])
def test_standard_output_is_for_results_alone(name: str, option: str, tmp_path: Path) -> None:
    command = command_with(name, tmp_path, **{option: Path("-")})
    refused(command, tmp_path, "must be a path, got '-'")


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
def test_a_command_refused_for_its_input_leaves_no_new_folder(
    name: str, option: str, tmp_path: Path
) -> None:
    source = existing(tmp_path / f"source{SUFFIX}")
    value, _ = output_at(name, option, tmp_path / "new" / "below")
    values = {option: value}
    if name != "golden":
        values |= dict.fromkeys(inputs_of(name)[:1], source)
    command = command_with(name, tmp_path, **values)
    before = state(tmp_path)
    done(*command, code=2)
    assert state(tmp_path) == before, command


def inputs_met() -> Iterator[tuple[str, str, str]]:
    for name, option in WRITERS:
        for source in inputs_of(name):
            if (name, source) not in TOGETHER_REFUSED:
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
    source_path = existing(file if how == "itself" else tmp_path / f"source{SUFFIX}")
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
    scene = existing(tmp_path / "scenes" / f"scene{SUFFIX}")
    if source == "pairs":
        scene = existing(tmp_path / "scenes" / "reference" / f"scene{SUFFIX}")
    command = command_with(name, tmp_path, **{option: scene, source: tmp_path / "scenes"})
    refused(command, tmp_path, str(scene), "an input of this run")


def test_figures_of_an_earlier_run_next_to_the_images_are_replaced(tmp_path: Path) -> None:
    """The rule does not stop a job that is run twice: it gets as far as reading the images."""
    existing(tmp_path / "scenes" / "scene.png")
    figures = Table(command="evaluate").save(tmp_path / "scenes" / "figures.json")
    output = done(f"evaluate --images {figures.parent} --json {figures}", code=2)
    assert "scene.png" in output


@pytest.mark.parametrize("command", ["evaluate", "simulate"])
def test_an_output_folder_is_no_folder_of_an_input(command: str, tmp_path: Path) -> None:
    scene = existing(tmp_path / "scenes" / "degraded" / "scene.tif")
    arguments_of = {
        "evaluate": f"--images {scene.parent} --out {scene.parent}".split(),
        "simulate": f"--images {scene} --out {tmp_path}/scenes".split(),
    }
    refused([command, *arguments_of[command]], tmp_path, "the folder of an input")


def pairs_of_outputs() -> Iterator[tuple[str, str, str]]:
    """Yield every command with each two of its outputs."""
    for name in COMMANDS:
        for one, other in combinations(outputs_of(name), 2):
            yield name, one, other


@pytest.mark.parametrize(("name", "one", "other"), list(pairs_of_outputs()))
def test_no_two_outputs_are_one(name: str, one: str, other: str, tmp_path: Path) -> None:
    first = other if (name, other) in FOLDERS else one
    second = one if first == other else other
    value, file = output_at(name, first, tmp_path)
    words = str(tmp_path), "another output"
    refused(command_with(name, tmp_path, **{first: value, second: file}), tmp_path, *words)
    (tmp_path / "detour").mkdir(exist_ok=True)
    around = tmp_path / "detour" / ".." / file.relative_to(tmp_path)
    refused(command_with(name, tmp_path, **{first: value, second: around}), tmp_path, *words)


def test_the_curves_of_bit_flips_are_an_output_too(tmp_path: Path) -> None:
    core = existing(tmp_path / "curves.svg")
    command = f"stress --bit-flips {core} {core} --out {tmp_path}/curves.md".split()
    refused(command, tmp_path, "curves.svg", "an input of this run")


def test_a_socket_is_no_output(working_folder: Path) -> None:
    if not hasattr(socket, "AF_UNIX"):
        pytest.skip("this system has no such sockets")
    # The path of a socket must be short, so the name is relative.
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("figures.json")
        refused(["bench", "--json", "figures.json"], working_folder, "not a regular file")
