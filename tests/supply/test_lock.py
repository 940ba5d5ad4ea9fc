"""`requirements.lock` holds what pyproject.toml asks for, each version once and by its hashes."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PIN = re.compile(r"(?P<name>[\w.-]+)==(?P<version>[\w.!]+)(?P<hashes>( --hash=sha256:[0-9a-f]{64})+)")


def asked_for() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    return [
        *project["project"]["dependencies"],
        *extras["study"],
        *extras["torch"],
        *project["build-system"]["requires"],
    ]


def faults(lock: str, wanted: list[str]) -> list[str]:
    """What is wrong with a lock, a sentence each."""
    lines = [line for line in re.sub(r"\s*\\\n\s*", " ", lock).splitlines() if line and not line.startswith("#")]
    found = [f"no pin with its hashes: {line[:60]}" for line in lines if not PIN.fullmatch(line)]
    pins = {canonicalize_name(pin["name"]): pin["version"] for line in lines if (pin := PIN.fullmatch(line))}
    for requirement in map(Requirement, wanted):
        version = pins.get(canonicalize_name(requirement.name))
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            found.append(f"{requirement} is asked for, {version} is locked")
    return found


def test_the_lock_satisfies_the_project() -> None:
    assert faults((ROOT / "requirements.lock").read_text(), asked_for()) == []
