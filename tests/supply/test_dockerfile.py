"""Tests of the Dockerfile: pinned bases, packages by hash, named folders, no root."""

import json
import re
import tomllib
from itertools import chain

from tests.project_files import ROOT, text_of

PINNED = re.compile(r"[\w./-]+:\d+\.\d+\.\d+[\w.-]*@sha256:[0-9a-f]{64}")
FETCHES = re.compile(r"\b(curl|wget|git clone)\b|https?://")
PINNED_INSTALL = re.compile(r"--require-hashes|--no-index|install( --[\w-]+)* [\w-]+==[\d.]+$")


def arguments_of(*words: str) -> list[str]:
    """Return the arguments of these instructions, with continued lines joined."""
    text = re.sub(r"(?m)^\s*#.*\n", "", text_of("Dockerfile")).replace("\\\n", " ")
    parts = [line.strip().partition(" ") for line in text.splitlines()]
    return [rest for word, _, rest in parts if word.upper() in words]


def copied() -> set[str]:
    """Return the paths that are copied from the repository into the image."""
    sources = set[str]()
    for copy in arguments_of("COPY"):
        if not copy.startswith("--"):
            sources |= {*copy.split()[:-1]}
    return sources


def test_bases_are_pinned_packages_hashed_and_root_is_not_used() -> None:
    starts = [rest.partition(" AS ") for rest in arguments_of("FROM")]
    stages = {stage for _, _, stage in starts}
    assert all(PINNED.fullmatch(base) for base, _, _ in starts if base not in stages)
    assert re.fullmatch(r"[1-9]\d*(:[1-9]\d*)?", arguments_of("USER")[-1])
    commands = arguments_of("RUN")
    assert arguments_of("ADD") == [command for command in commands if FETCHES.search(command)] == []
    assert not {".", "/", "*"} & copied()
    steps = chain.from_iterable(command.split("&&") for command in commands)
    assert all(PINNED_INSTALL.search(step.strip()) for step in steps if "pip install" in step)


def test_every_folder_of_the_package_reaches_the_image() -> None:
    lines = text_of(".dockerignore").splitlines()
    allowed = {line[1:] for line in lines if line.startswith("!")}
    assert {"setup.py", "profiles", "model", "quant", "deploy"} <= copied() <= allowed
    assert all((ROOT / name).exists() for name in copied())


def test_it_starts_the_command() -> None:
    (start,) = arguments_of("ENTRYPOINT")
    scripts = tomllib.loads(text_of("pyproject.toml"))["project"]["scripts"]
    assert json.loads(start) == list(scripts)
