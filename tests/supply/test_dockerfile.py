"""What the Dockerfile promises: pinned bases, packages by hash, named folders, no root."""

import json
import re
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PINNED = re.compile(r"[\w./-]+:\d+\.\d+\.\d+[\w.-]*@sha256:[0-9a-f]{64}")
FETCHES = re.compile(r"\b(curl|wget|git clone)\b|https?://")
SOUND_INSTALL = re.compile(r"--require-hashes|--no-index|install( --[\w-]+)* [\w-]+==[\d.]+$")


def instructions(dockerfile: str) -> list[tuple[str, str]]:
    """Each instruction's word and its arguments; comments left out, continued lines joined."""
    text = re.sub(r"(?m)^\s*#.*\n", "", dockerfile).replace("\\\n", " ")
    return [
        (word.upper(), rest)
        for word, _, rest in (line.strip().partition(" ") for line in text.splitlines())
        if word
    ]


def test_bases_are_pinned_packages_hashed_and_root_is_not_used() -> None:
    dockerfile = instructions((ROOT / "Dockerfile").read_text())
    stages = {rest.partition(" AS ")[2] for word, rest in dockerfile if word == "FROM"}
    bases = {rest.partition(" AS ")[0] for word, rest in dockerfile if word == "FROM"}
    assert all(PINNED.fullmatch(base) for base in bases - stages)
    assert re.fullmatch(
        r"[1-9]\d*(:[1-9]\d*)?", [rest for word, rest in dockerfile if word == "USER"][-1]
    )
    assert not [
        rest
        for word, rest in dockerfile
        if word == "ADD" or (word == "RUN" and FETCHES.search(rest))
    ]
    copied = [
        rest.split()[:-1]
        for word, rest in dockerfile
        if word == "COPY" and not rest.startswith("--from=")
    ]
    assert not {".", "/", "*"} & {*chain.from_iterable(copied)}
    commands = [rest for word, rest in dockerfile if word == "RUN"]
    steps = chain.from_iterable(command.split("&&") for command in commands)
    assert all(SOUND_INSTALL.search(step.strip()) for step in steps if "pip install" in step)


def test_every_folder_of_the_package_reaches_the_image() -> None:
    copies = [
        rest.split()
        for word, rest in instructions((ROOT / "Dockerfile").read_text())
        if word == "COPY"
    ]
    copied = set[str]()
    for names in copies:
        if not names[0].startswith("--"):
            copied |= {*names[:-1]}
    let_in = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line.startswith("!")
    }
    assert {"setup.py", "profiles", "model", "quant", "deploy"} <= copied <= let_in
    assert all((ROOT / name).exists() for name in copied)


def test_it_starts_the_command() -> None:
    (start,) = (
        rest
        for word, rest in instructions((ROOT / "Dockerfile").read_text())
        if word == "ENTRYPOINT"
    )
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert json.loads(start) == list(scripts)
