"""Tests that the locks satisfy pyproject.toml, and that the core's lock is part of the other."""

import re
import tomllib

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.project_files import text_of

PIN = re.compile(
    r"(?P<name>[\w.-]+)==(?P<version>[\w.!]+)(?P<hashes>( --hash=sha256:[0-9a-f]{64})+)"
)

PINNED = re.compile(r"(?m)^[\w.-]+==[\w.!]+")


def requirements_of(*extras: str) -> list[str]:
    project = tomllib.loads(text_of("pyproject.toml"))
    requirements = []
    for extra in extras:
        requirements += project["project"]["optional-dependencies"][extra]
    return [
        *project["project"]["dependencies"],
        *requirements,
        *project["build-system"]["requires"],
    ]


def faults(lock: str, requirements: list[str]) -> list[str]:
    """Return the faults of a lock, one sentence each."""
    lines = [
        line
        for line in re.sub(r"\s*\\\n\s*", " ", lock).splitlines()
        if line and not line.startswith("#")
    ]
    sentences = [
        f"no pin with its hashes: {line[:60]}" for line in lines if not PIN.fullmatch(line)
    ]
    pins = {
        canonicalize_name(pin["name"]): pin["version"]
        for line in lines
        if (pin := PIN.fullmatch(line))
    }
    for requirement in map(Requirement, requirements):
        version = pins.get(canonicalize_name(requirement.name))
        if version is None or not requirement.specifier.contains(version, prereleases=True):
            sentences.append(f"{requirement} is required, but {version} is locked")
    return sentences


def test_the_locks_satisfy_the_project() -> None:
    full, core = (text_of(name) for name in ("requirements.lock", "requirements-core.lock"))
    assert faults(full, requirements_of("study", "torch")) == []
    assert faults(core, requirements_of()) == []
    assert set(PINNED.findall(core)) < set(PINNED.findall(full))
    assert "torch==" not in core
