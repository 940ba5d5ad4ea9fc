"""Run the shell steps of a GitHub workflow or a composite action, one after the other, in a folder.

Only the expressions and conditions of our own files are supported. Any other is an error, and so is
a name that nothing defines. Steps of other actions (checkout, setup-python, uploads) and steps that
install are skipped.
"""

import os
import re
import subprocess
import sys
import sysconfig
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]  # its stubs are one more package, for one function

from tests.project_files import ROOT

ACTION = ROOT / "action.yml"

EXPRESSION = re.compile(r"\$\{\{ (.+?) \}\}")
IS_EMPTY = re.compile(r"([\w.-]+) == ''")
BASH = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c"]
"""The command with which GitHub runs `shell: bash`."""

SHORT = {"quantize": "--patches 2 --patch 32", "gate": "--patches 2"}
"""Options that the tests add to commands, so that they take seconds."""


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a workflow or an action."""
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return content


@dataclass
class Runner:
    """One job in a folder.

    Attributes:
        folder: the workspace.
        red: whether a step has failed; later steps are skipped, unless they always run.
        stderr: the standard error of the failed step.
        stdout: the standard output of all steps, with their workflow commands.
        outputs: the outputs of the steps, by "steps.ID.outputs.NAME".
    """

    folder: Path
    red: bool = False
    stderr: str = ""
    stdout: str = ""
    outputs: dict[str, str] = field(default_factory=dict)

    def prepare(self) -> None:
        """Write the commands, and a summary that an earlier step began."""
        (self.temporary / "command").mkdir(parents=True)
        self.summary.write_text("what a step before wrote\n")
        lines = [f'{name}) set -- "$@" {more};;' for name, more in SHORT.items()]
        self.command(
            "beers-deploy",
            f'echo "$*" >> "{self.calls}"; case "$1" in {" ".join(lines)} esac',
            '"$@"',
        )
        # The call is "pipx run --spec . beers-deploy ...".
        self.command("pipx", "shift 3", '"${@:2}"')

    @property
    def temporary(self) -> Path:
        """Return the folder of RUNNER_TEMP."""
        return self.folder.parent / "temporary"

    @property
    def summary(self) -> Path:
        """Return the file of GITHUB_STEP_SUMMARY."""
        return self.temporary / "summary.md"

    @property
    def calls(self) -> Path:
        """Return the file with the arguments of every call of beers-deploy, a line each."""
        return self.temporary / "calls"

    def command(self, name: str, before: str, arguments: str) -> None:
        """Put a command on the path that runs `before` and then our command."""
        real = Path(sysconfig.get_path("scripts")) / "beers-deploy"
        path = self.temporary / "command" / name
        path.write_text(f'#!/usr/bin/env bash\n{before}\nexec "{real}" {arguments}\n')
        path.chmod(0o755)

    def run_action(self, values: dict[str, str]) -> dict[str, str]:
        """Run the action with these inputs, and return its outputs."""
        action = read_yaml(ACTION)
        inputs = {name: str(about.get("default", "")) for name, about in action["inputs"].items()}
        assert values.keys() <= inputs.keys()
        inputs.update(values)
        context = {f"inputs.{name}": text for name, text in inputs.items()} | {
            "github.action_path": str(ROOT)
        }
        # The step that would set this output is skipped.
        context["steps.python.outputs.python-path"] = sys.executable
        # An action's steps have ids of their own.
        own = Runner(self.folder)
        own.run_steps(action["runs"]["steps"], context)
        self.red = own.red
        self.stderr = own.stderr
        self.stdout = self.stdout + own.stdout
        names = context | own.outputs
        return {name: value_of(about["value"], names) for name, about in action["outputs"].items()}

    def run_steps(self, steps: list[dict[str, Any]], context: dict[str, str]) -> None:
        """Run every step whose condition holds."""
        for step in steps:
            condition = step.get("if", "")
            if condition != "always()" and (self.red or not holds(condition, context)):
                continue
            if step.get("uses") == "./":
                inputs = {
                    name: value_of(str(text), context | self.outputs)
                    for name, text in step["with"].items()
                }
                outputs = self.run_action(inputs)
                self.outputs |= {
                    f"steps.{step['id']}.outputs.{name}": text for name, text in outputs.items()
                }
            elif "run" in step and "pip install" not in step["run"]:
                self.run_shell(step, context)

    def run_shell(self, step: dict[str, Any], context: dict[str, str]) -> None:
        """Run the script of one step, and collect its outputs even if it fails."""
        file = self.temporary / "outputs"
        file.write_text("")
        names = context | self.outputs
        variables = {name: value_of(str(text), names) for name, text in step.get("env", {}).items()}
        assert "${{" not in step["run"], "values reach the shell by its environment"
        process = subprocess.run(
            [*BASH, step["run"]], cwd=self.folder, env=self.environment | variables, **KEPT
        )
        lines = [line.partition("=") for line in file.read_text(encoding="utf-8").splitlines()]
        self.outputs |= {f"steps.{step['id']}.outputs.{name}": text for name, _, text in lines}
        self.stdout += process.stdout
        if process.returncode:
            self.red = True
            self.stderr = process.stderr

    @property
    def environment(self) -> dict[str, str]:
        """Return the environment variables that the runner sets for each step."""
        return {
            "PATH": f"{self.temporary / 'command'}:{os.environ['PATH']}",
            "HOME": str(self.temporary),
            "PYTHONPATH": str(ROOT),
            "RUNNER_TEMP": str(self.temporary),
            "RUNNER_OS": "Linux",
            "GITHUB_OUTPUT": str(self.temporary / "outputs"),
            "GITHUB_PATH": str(self.temporary / "path"),
            "GITHUB_STEP_SUMMARY": str(self.summary),
        }


KEPT: dict[str, Any] = {"capture_output": True, "text": True}


def value_of(text: str, context: dict[str, str]) -> str:
    """Replace each expression in a text by the first of its names that is not empty."""

    def replaced(match: re.Match[str]) -> str:
        names = match[1].split(" || ")
        return next((value for value in (lookup(name, context) for name in names) if value), "")

    return EXPRESSION.sub(replaced, text)


def lookup(name: str, context: dict[str, str]) -> str:
    """Return a name's value, or a quoted text. An output that no step wrote is empty, as in
    GitHub.
    """
    if name.startswith("'"):
        return name.strip("'")
    return (
        context.get(name, "")
        if re.fullmatch(r"steps\.\w+\.outputs\.[\w-]+", name)
        else context[name]
    )


def holds(condition: str, context: dict[str, str]) -> bool:
    """Return True if a step runs: it has no condition, or the input of its condition is empty."""
    if not condition:
        return True
    match = IS_EMPTY.fullmatch(condition)
    assert match, condition
    return lookup(match[1], context) == ""
