"""What the Dockerfile promises: pinned bases, packages by hash, named folders, no root."""

import json
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PINNED = re.compile(r"[\w./-]+:\d+\.\d+\.\d+[\w.-]*@sha256:[0-9a-f]{64}")
FETCHES = re.compile(r"\b(curl|wget|git clone)\b|https?://")
SOUND_INSTALL = re.compile(r"--require-hashes|--no-index|install( --[\w-]+)* [\w-]+==[\d.]+$")


def instructions(dockerfile: str) -> list[tuple[str, str]]:
    """Each instruction's word and its arguments; comments left out, continued lines joined."""
    text = re.sub(r"(?m)^\s*#.*\n", "", dockerfile).replace("\\\n", " ")
    return [
        (word.upper(), rest) for word, _, rest in (line.strip().partition(" ") for line in text.splitlines()) if word
    ]


def faults(dockerfile: str) -> list[str]:
    """What is wrong with a Dockerfile, a sentence each."""
    found, stages, user = [], set[str](), "root"
    for word, rest in instructions(dockerfile):
        if word == "FROM":
            base, _, stage = rest.partition(" AS ")
            if base not in stages and not PINNED.fullmatch(base):
                found.append(f"base without an exact version and a digest: {base}")
            stages.add(stage)
            user = "root"
        elif word == "USER":
            user = rest
        else:
            found.extend(_faults_of(word, rest))
    if not re.fullmatch(r"[1-9]\d*(:[1-9]\d*)?", user):
        found.append(f"runs as {user}, which is not known to be no root")
    return found


def _faults_of(word: str, rest: str) -> list[str]:
    if word == "ADD":
        return [f"ADD may fetch and unpack: {rest}"]
    if word == "COPY" and not rest.startswith("--from=") and {".", "/", "*"} & set(rest.split()[:-1]):
        return [f"copies what is not named: {rest}"]
    if word != "RUN":
        return []
    installs = [part.strip() for part in rest.split("&&") if "pip install" in part]
    loose = [f"installs without hashes: {part}" for part in installs if not SOUND_INSTALL.search(part)]
    return loose + ([f"fetches: {rest}"] if FETCHES.search(rest) else [])


def test_the_dockerfile_keeps_its_promises() -> None:
    assert faults((ROOT / "Dockerfile").read_text()) == []


def test_every_folder_of_the_package_reaches_the_image() -> None:
    copies = [rest.split() for word, rest in instructions((ROOT / "Dockerfile").read_text()) if word == "COPY"]
    copied = {name for names in copies if not names[0].startswith("--") for name in names[:-1]}
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert {"setup.py", "profiles", "model", "quant", "deploy"} <= copied <= let_in
    assert all((ROOT / name).exists() for name in copied)


def test_it_starts_the_command() -> None:
    (start,) = (rest for word, rest in instructions((ROOT / "Dockerfile").read_text()) if word == "ENTRYPOINT")
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert json.loads(start) == list(scripts)
