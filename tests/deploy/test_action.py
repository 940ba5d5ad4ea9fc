"""Test that the action and the workflow to copy are green for a valid pair, and red for a broken or
a missing one. Their steps run in a shell.
"""

import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import onnx
import pytest

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.shipped import SENSOR
from beers_deploy.model.variants import Variant
from beers_deploy.quant.onnx_file import save_onnx
from tests.deploy.command_line import done
from tests.deploy.documents import valid
from tests.deploy.workflow_steps import ACTION, BASH, KEPT, Runner, read_yaml
from tests.model.networks import plain
from tests.project_files import ROOT, text_of
from tests.quant.quick import changed
from tests.quant.simplify.networks import parsed
from tests.shipped import shipped_pair

WORKFLOW = ROOT / ".github/workflows/int8-gate.yml"
OURS = "Train a small network"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        sys.platform == "win32", reason="the steps run in bash, which Windows has not of itself"
    ),
]


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a valid pair, a broken INT8 file, and in plain/ a network of one sensor."""
    folder = tmp_path_factory.mktemp("networks")
    done(f"export --network convbeers-xs --out {folder}/float.onnx")
    shutil.copy(shipped_pair("convbeers-xs")[1], folder / "int8.onnx")
    model = onnx.load(folder / "int8.onnx")
    name = next(node.input[8] for node in model.graph.node if node.op_type == "QLinearConv")
    onnx.save(changed(model, name, lambda bias: 2 * bias), folder / "broken.onnx")
    save_onnx(to_onnx(plain(Variant(blocks=1, features=8)), {}), folder / "plain" / "float.onnx")
    return folder


@pytest.fixture
def runner(tmp_path: Path) -> Runner:
    (tmp_path / "workspace").mkdir()
    job = Runner(tmp_path / "workspace")
    job.prepare()
    return job


def copy_networks(runner: Runner, networks: Path, *names: str) -> None:
    """Copy networks to models/, where a user's repository has them."""
    (runner.folder / "models").mkdir(exist_ok=True)
    for name in names:
        shutil.copy(networks / name, runner.folder / "models" / name)


def suite(path: Path) -> ET.Element:
    return ET.parse(path).getroot()  # noqa: S314 - our own text


def test_a_valid_pair_is_green(runner: Runner, networks: Path) -> None:
    copy_networks(runner, networks, "float.onnx", "int8.onnx")
    outputs = runner.run_action(
        {"float": "models/float.onnx", "int8": "models/int8.onnx", "junit": "made/j.xml"}
    )
    assert not runner.red, runner.stderr
    assert outputs["verdict"] == "passed"
    assert 0 < float(outputs["mae"]) < 0.0007
    assert 0 < float(outputs["drop"]) < 1
    assert (outputs["int8"], outputs["board"]) == ("models/int8.onnx", "")
    assert runner.summary.read_text().startswith(
        "what a step before wrote\n\n## INT8 gate: passed\n"
    )
    assert "| MAE | 0.000" in runner.summary.read_text()
    assert suite(runner.folder / "made" / "j.xml").get("failures") == "0"
    assert valid(runner.folder / "gate.json")["verdict"] == "passed"


def test_a_broken_pair_is_red(runner: Runner, networks: Path) -> None:
    """The first convolution's bias is doubled, and the baseline is that of the valid pair."""
    copy_networks(runner, networks, "float.onnx", "int8.onnx", "broken.onnx")
    pair = {"float": "models/float.onnx", "int8": "models/int8.onnx"}
    outputs_before = runner.run_action({**pair, "json": "models/gate.json"})
    assert outputs_before["verdict"] == "passed"
    outputs = runner.run_action(
        {**pair, "int8": "models/broken.onnx", "baseline": "models/gate.json"}
    )
    assert runner.red
    assert outputs["verdict"] == "failed"
    assert float(outputs["mae"]) > 0
    assert "**failed**" in runner.summary.read_text()
    failed = {
        case.get("name")
        for case in suite(runner.folder / "gate.xml")
        if case.find("failure") is not None
    }
    assert "MAE against the baseline" in failed


@pytest.mark.parametrize("more", [{}, {"int8": "models/int8.onnx"}])
def test_a_missing_float_network_is_red_in_one_sentence(
    more: dict[str, str], runner: Runner, networks: Path
) -> None:
    copy_networks(runner, networks, "int8.onnx")
    outputs = runner.run_action({"float": "models/float.onnx", **more})
    assert runner.red
    assert runner.stderr.count("\n") == 1
    assert "models/float.onnx cannot be read: no such file" in runner.stderr
    assert outputs["verdict"] == "error"
    assert (outputs["mae"], outputs["drop"]) == ("", "")
    assert runner.stderr in runner.summary.read_text()
    assert not (runner.folder / "gate.json").exists()


def test_without_an_int8_network_it_quantizes_for_the_same_sensor(
    runner: Runner, networks: Path
) -> None:
    copy_networks(runner, networks / "plain", "float.onnx")
    sensor = runner.folder / "mine.toml"
    shutil.copy(ROOT / f"profiles/sensors/{SENSOR}.toml", sensor)
    outputs = runner.run_action(
        {"float": "models/float.onnx", "sensor": "mine.toml", "max-mae": "0.001"}
    )
    assert not runner.red, runner.stderr
    assert outputs["verdict"] == "passed"
    for name in ("int8", "board"):
        assert Path(outputs[name]).is_relative_to(runner.temporary)
        assert onnx.load(outputs[name]).graph.node
    calls = runner.calls.read_text().splitlines()
    assert [call.split()[0] for call in calls] == ["quantize", "gate"]
    assert all("--target vck190 --sensor mine.toml" in call for call in calls)
    arguments = valid(runner.folder / "gate.json")["arguments"]
    assert (arguments["sensor"], arguments["max_mae"]) == ("mine", 0.001)


def test_a_network_that_quantize_refuses_is_an_error_whose_reason_is_in_the_summary(
    runner: Runner,
) -> None:
    """This holds also if the document of a version that passed is where the verdict goes."""
    model = parsed("y = Sin(x)", "float[1,1,h,w] x => float[1,1,h,w] y")
    model.graph.node[0].name = "odd\n::error::obeyed | `name` <b>"
    (runner.folder / "models").mkdir()
    save_onnx(model, runner.folder / "models" / "float.onnx")
    (runner.folder / "gate.json").write_text('{"verdict": "passed"}')
    outputs = runner.run_action({"float": "models/float.onnx"})
    assert runner.red
    assert outputs["verdict"] == "error"
    summary = runner.summary.read_text()
    assert "## INT8 gate: not judged" in summary
    message = runner.stderr.splitlines()[-1]
    assert message.startswith("beers-deploy: ")
    assert message in summary
    assert [call.split()[0] for call in runner.calls.read_text().splitlines()] == ["quantize"]
    assert obeyed(runner.stdout) == ["error title=INT8 gate%3A not judged"]


def obeyed(stdout: str) -> list[str]:
    """Return the workflow commands that GitHub obeys in an output, up to their second colons."""
    commands = list[str]()
    token = ""
    for line in stdout.splitlines():
        if token and line == f"::{token}::":
            token = ""
        elif line.startswith("::stop-commands::") and not token:
            token = line.removeprefix("::stop-commands::")
        elif line.startswith("::") and not token:
            commands.append(line[2:].partition("::")[0])
    return commands


def test_inputs_are_never_run_as_commands(runner: Runner) -> None:
    inputs = dict.fromkeys(
        ("float", "int8", "sensor", "limits"), "$(touch ran) `touch ran` ; touch ran"
    )
    assert runner.run_action(inputs)["verdict"] == "error"
    assert not (runner.folder / "ran").exists()


def test_every_input_and_output_of_the_action_is_described() -> None:
    action = read_yaml(ACTION)
    page = text_of("docs/how-to/gate.md")
    assert action["inputs"]["sensor"]["default"] == SENSOR
    for kind in ("inputs", "outputs"):
        for name, about in action[kind].items():
            assert about["description"].endswith(".")
            assert f"- `{name}`" in page, f"docs/how-to/gate.md lacks the {kind[:-1]} {name}"


def test_installing_puts_the_command_alone_on_the_path(tmp_path: Path) -> None:
    """A script in place of Python logs its arguments, because a test has no package index."""
    steps = read_yaml(ACTION)["runs"]["steps"]
    (step,) = (step for step in steps if "pip install" in step.get("run", ""))
    python = tmp_path / "python"
    python.write_text(
        '#!/usr/bin/env bash\necho "$*" >> "$LOG"\n'
        'if [ "$2" = venv ]; then mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; fi\n'
        'if [ "$3" = install ]; then echo ok > "$(dirname "$0")/beers-deploy"; fi\n'
    )
    python.chmod(0o755)
    variables = {
        "PYTHON": str(python),
        "SOURCE": "the action",
        "RUNNER_TEMP": str(tmp_path),
        "RUNNER_OS": "Linux",
    }
    files = {
        "LOG": str(tmp_path / "log"),
        "GITHUB_PATH": str(tmp_path / "path"),
        "PATH": "/usr/bin:/bin",
    }
    process = subprocess.run([*BASH, step["run"]], cwd=tmp_path, env=variables | files, **KEPT)
    assert process.returncode == 0, process.stderr
    venv = tmp_path / "beers-deploy"
    assert (tmp_path / "log").read_text() == f"-m venv {venv}\n-m pip install --quiet the action\n"
    (folder,) = (tmp_path / "path").read_text().splitlines()
    assert [path.name for path in Path(folder).iterdir()] == ["beers-deploy"]
    assert "PIP_EXTRA_INDEX_URL" not in step["env"]


def test_the_workflow_is_green_with_one(runner: Runner, networks: Path) -> None:
    copy_networks(runner, networks / "plain", "float.onnx")
    # The workflow's second checkout leaves the limits of the protected branch here.
    limits = runner.folder / "protected" / ".ci" / "gate.toml"
    limits.parent.mkdir(parents=True)
    limits.write_text("mae = 0.001\npsnr_drop_db = 0.4\n")
    (job,) = read_yaml(WORKFLOW)["jobs"].values()
    steps = [step for step in job["steps"] if step.get("name") != OURS]
    runner.run_steps(steps, {})
    assert not runner.red, runner.stderr
    assert runner.outputs["steps.gate.outputs.verdict"] == "passed"
    assert (runner.folder / "gate.xml").is_file()


def test_the_workflow_asks_for_no_cache_of_packages() -> None:
    """`cache: pip` stops in a repository that has no requirements.txt or pyproject.toml."""
    for path in (WORKFLOW, ACTION):
        assert "cache:" not in path.read_text()
