"""Tests of the command line: help, exit codes, one sentence for each fault, no partial files."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import tifffile
from PIL import Image
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from beers_deploy import __version__
from beers_deploy.cli.commands import COMMANDS, app
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import CRASHED
from tests.deploy.command_line import done, refused
from tests.deploy.dpu.graphs import MYSTERY, written
from tests.profiles.own_sensor import SHIPPED, edited, own_sensor


def acquisition(path: Path, height: int = 37, width: int = 61) -> Path:
    dn = np.random.default_rng(0).integers(200, 1800, (height, width))
    tifffile.imwrite(path, dn.astype(np.uint16))
    return path


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name: str) -> None:
    output = done(name, "--help")
    assert f"beers-deploy {name}" in " ".join(output.split())
    assert "Example" in output


def test_commands_without_a_sensor_use_the_same_one() -> None:
    """A network that is calibrated on one sensor and judged on another is not judged fairly."""
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    defaults = {}
    for name, command in group.commands.items():
        for option in command.params:
            if option.name == "sensor":
                defaults[name] = option.default
    assert {"quantize", "gate", "evaluate"} <= set(defaults)
    # Only the user knows the sensor of a raw image.
    assert defaults.pop("restore") == "blind"
    assert set(defaults.values()) == {SENSOR, None}


OPTIONAL = {"torch", "dask", "distributed", "xarray", "matplotlib", "pycocotools", "skimage"}
CALL = "from beers_deploy.cli.commands import app; app({}, standalone_mode=False)"


@pytest.mark.parametrize(
    ("code", "packages"),
    [
        (
            "import beers_deploy.cli.commands",
            OPTIONAL | {"onnxruntime", "onnx", "scipy", "numpy", "rasterio", "PIL"},
        ),
        ("from beers_deploy import restore", OPTIONAL),
        (CALL.format(["check"]), OPTIONAL),
        (CALL.format(["bench", "--no-traditional"]), {"torch"}),
    ],
)
def test_only_what_is_needed_is_imported(code: str, packages: set[str]) -> None:
    command = [sys.executable, "-c", f"import sys; {code}; print({packages} & set(sys.modules))"]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    assert process.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("--tile abc", "'--tile': it must be a valid integer, got 'abc'."),
        ("--tile 7", "'--tile': it must be greater than or equal to 16, got '7'."),
        ("--memory 5x", "'--memory': it must be a valid number, got '5x'."),
        ("--runtime torch", "'--runtime': 'torch' is not one of 'onnxruntime', 'openvino'."),
    ],
)
def test_a_value_that_an_option_does_not_accept_is_named(words: str, reason: str) -> None:
    assert refused(f"restore raw.tif out.tif {words}").endswith(f"Invalid value for {reason}")


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["", "out.tif"], "an argument"),
        (["raw.tif", "out.tif", "--self-check", ""], "--self-check"),
    ],
)
def test_an_empty_word_is_named_and_not_read_as_the_working_folder(
    words: list[str], name: str
) -> None:
    assert refused("restore", *words).endswith(f"{name} is empty. Give a value, or leave it out.")


def test_a_working_folder_that_was_deleted_is_no_fault_of_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "deleted"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    message = refused("restore", acquisition(tmp_path / "in.tif"), "out.tif")
    assert "The working folder was deleted" in message


def test_version() -> None:
    assert done("--version") == f"beers-deploy {__version__}\n"


@pytest.mark.parametrize("options", ["--version --verbose", "--verbose --version"])
def test_the_verbose_version_lists_libraries_and_int8_kernels(options: str) -> None:
    lines = dict(line.split(": ", 1) for line in done(options).splitlines()[1:])
    expected = {"system", "machine", "int8 on onnxruntime", "onnxruntime", "torch", "openvino"}
    assert expected <= set(lines)


def test_a_name_that_the_terminal_cannot_show_ends_no_run(tmp_path: Path) -> None:
    image = acquisition(tmp_path / "\u6771\u4eac.tif", 40, 50)
    # Pipes have this encoding on Windows.
    terminal = CliRunner(charset="cp1252")
    result = terminal.invoke(app, ["restore", str(image), str(tmp_path / "out.tif")])
    assert result.exit_code == 0, result.stderr
    assert "\\u6771\\u4eac" in result.stdout
    assert tifffile.imread(tmp_path / "out.tif").shape == (40, 50)


def test_a_photograph_is_no_raw_image_until_its_scale_is_named(tmp_path: Path) -> None:
    picture = tmp_path / "photo.jpg"
    out = tmp_path / "out.tif"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)).save(picture)
    message = refused("restore", picture, out)
    assert message.count("beers-deploy: ") == 1
    assert message.endswith(".")
    assert "--full-scale" in message
    assert "`" not in message, "a parameter in place of an option"
    assert not out.exists()
    done(f"restore {picture} {out} --full-scale 255")
    restored = tifffile.imread(out)
    assert restored.dtype == np.uint8
    assert restored.shape == (3, 40, 50)
    assert restored.max() <= 255


def test_profiles_show_scenes_targets_and_sensors_with_every_source() -> None:
    for name in ("snow", "vck190", "pleiades-variable"):
        assert "source" in done(f"profiles {name}")
    assert "pleiades-degraded" in done("profiles")
    output = done("profiles pleiades-degraded")
    assert "gain_dn_per_radiance" in output
    assert "assumed" in output
    assert "no effect with --toml" in refused("profiles pleiades-degraded --toml --json -")


def test_a_description_is_shown_and_not_obeyed(scenes: Path, tmp_path: Path) -> None:
    first = next(line for line in SHIPPED.splitlines() if line.startswith("description"))
    text = (
        edited((first, 'description = "a \\u001b]0;title\\u0007 \\u001b[31mred"')) + "# \x9b31m\n"
    )
    own = own_sensor(tmp_path, text=text)
    for more in ([], ["--toml"]):
        output = done(f"profiles {own}", *more)
        assert set("\x1b\x07\x9b").isdisjoint(output)
        assert "31m" in output
    assert "\x1b" not in refused("restore raw.tif", "\x1b[31m.png")
    assert "\x1b" not in done(f"simulate --explain --images {scenes} --sensor {own}")


def run_with(closing: str, *words: object) -> tuple[int, str]:
    """Run the program with redirected streams, and return its exit code and remaining output."""
    words = (sys.executable, "-m", "beers_deploy", *words)
    line = ["/usr/bin/env", "bash", "-c", f'"$@" {closing}', "bash", *map(str, words)]
    process = subprocess.run(line, capture_output=True, text=True)
    return process.returncode, process.stdout + process.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here: Linux has one")
@pytest.mark.parametrize(
    ("closing", "code"),
    [(">&- 2>&-", 0), ("> /dev/full", 70), ("2>&1 | true; exit ${PIPESTATUS[0]}", 0)],
)
def test_no_stream_loses_an_image(closing: str, code: int, tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "in.tif",
        np.random.default_rng(0).integers(900, 1200, (40, 50)).astype(np.uint16),
    )
    network = ("--network", "convbeers-xs-int8")
    exit_code, output = run_with(
        closing, "restore", tmp_path / "in.tif", tmp_path / "out.tif", *network
    )
    assert tifffile.imread(tmp_path / "out.tif").shape == (40, 50)
    assert "Traceback" not in output
    assert exit_code == code


@pytest.mark.parametrize(
    ("words", "code"), [(["--version"], 0), (["check", "--target", "zcu104", "{network}"], 1)]
)
def test_a_reader_that_closes_its_pipe_changes_no_exit_code(
    words: list[str], code: int, tmp_path: Path
) -> None:
    onnx.save_model(written(MYSTERY), tmp_path / "mystery.onnx")
    reading, writing = os.pipe()
    os.close(reading)
    words = [word.format(network=tmp_path / "mystery.onnx") for word in words]
    process = subprocess.run(
        [sys.executable, "-m", "beers_deploy", *words], stdout=writing, stderr=subprocess.PIPE
    )
    os.close(writing)
    assert (process.returncode, process.stderr) == (code, b"")


def test_names_that_are_not_utf8_are_refused_before_any_work(tmp_path: Path) -> None:
    """GDAL's Python module opens no other names, and would say so after the last row."""
    image = acquisition(tmp_path / "in.tif")
    latin = os.fsdecode(os.fsencode(tmp_path) + b"/\xe9.tif")
    for words in ((image, latin), (latin, tmp_path / "out.tif")):
        assert "not UTF-8" in refused("restore", *words)
    assert list(tmp_path.iterdir()) == [image]


@pytest.mark.parametrize("module", ["typing_extensions", "numpy"])
def test_an_installation_that_does_not_work_is_no_failed_gate(module: str, tmp_path: Path) -> None:
    """If a library does not load, Python ends with 1, which is the code of a failed gate."""
    (tmp_path / f"{module}.py").write_text("raise RuntimeError('broken')\n", encoding="utf-8")
    command = [sys.executable, "-m", "beers_deploy", "--version", "-v"]
    process = subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == CRASHED
    assert process.stderr.splitlines()[-1].startswith(
        "beers-deploy: this installation does not work"
    )
