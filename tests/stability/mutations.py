"""Break a copy of this code ten times, and print which stability tests notice.

Run `python -m tests.stability.mutations` from the repository root; it takes some minutes. Each
mutation in mutations.toml changes one or two lines of the product, and the stability tests listed
there run on the copy. The tests of a mutation must fail; without a mutation all must pass. The
exit code is 1 if a mutation survives. test_mutations.py checks that the list fits the code.
"""

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile

from beers_deploy.model.progress import steps

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("mutations.toml")
SUITE = "tests/stability"
PROBE_FILE = "test_copy.py"
FAILED = re.compile(r"^(?:FAILED|ERROR) \S+/(\w+\.py::\w+)", re.MULTILINE)
PROBE = """
from pathlib import Path
import beers_deploy
from beers_deploy import model, profiles, quant

def test_the_copy_is_what_runs():
    here = Path(__file__).resolve().parents[2]
    modules = (beers_deploy, model, profiles, quant)
    assert {Path(each.__file__).resolve().parents[1] for each in modules} == {here}
"""

Failures = Mapping[str, int]
"""The number of failed cases of each test that failed, by `file::function`."""


@dataclass(frozen=True)
class Mutation:
    """One way to break the product, see mutations.toml."""

    name: str
    meaning: str
    file: str
    changes: list[tuple[str, str]]
    tests: list[str]


MUTATIONS = tuple(
    Mutation(**entry) for entry in tomllib.loads(LIST.read_text(encoding="utf-8"))["mutation"]
)


def broken(text: str, mutation: Mutation) -> str:
    """Return the text of a file with the mutation.

    Raises:
        SystemExit: a text to be replaced does not occur exactly once.
    """
    for old, new in mutation.changes:
        if text.count(old) != 1:
            raise SystemExit(
                f"{mutation.name}: in {mutation.file} `{old}` occurs {text.count(old)} times, "
                "not once"
            )
        text = text.replace(old, new)
    return text


@contextmanager
def repository_copy() -> Iterator[Path]:
    """Yield a temporary copy of all files that git tracks or would add, with a test that checks
    that the copy is what runs.
    """
    command = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    listed = subprocess.check_output(command, cwd=ROOT, text=True)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder).resolve()
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                copyfile(ROOT / name, copy / name)
        # The installed package reaches these folders through links.
        for name in ("model", "profiles", "quant"):
            (copy / "deploy" / name).symlink_to(copy / name)
        (copy / "beers_deploy").symlink_to(copy / "deploy")
        (copy / SUITE / PROBE_FILE).write_text(PROBE, encoding="utf-8")
        yield copy


def failures_of(copy: Path, mutation: Mutation) -> Failures:
    """Break the copy, run its stability tests, and restore it."""
    file = copy / mutation.file
    original = file.read_text(encoding="utf-8")
    file.write_text(broken(original, mutation), encoding="utf-8")
    try:
        return failures(copy)
    finally:
        file.write_text(original, encoding="utf-8")


def failures(copy: Path) -> Failures:
    """Return the tests of the copy that fail, in the files that the list names.

    Raises:
        SystemExit: the tests could not run, or ran code outside the copy.
    """
    names = set[str]().union(*(mutation.tests for mutation in MUTATIONS))
    files = {name.partition("::")[0] for name in names}
    paths = [f"{SUITE}/{name}" for name in sorted({PROBE_FILE, *files})]
    options = ["-n0", "-pno:cacheprovider", "--tb=no", "-q", "-rfE", "--hypothesis-seed=0"]
    process = subprocess.run(
        [sys.executable, "-m", "pytest", *paths, *options],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )
    if process.returncode not in (0, 1):
        raise SystemExit(process.stdout + process.stderr)
    tests = Counter(FAILED.findall(process.stdout))
    if any(name.startswith(PROBE_FILE) for name in tests):
        raise SystemExit(f"the tests in {copy} run code outside of it")
    return tests


def summary(mutation: Mutation, failing: Failures) -> str:
    """Return one line on a mutation: its name, and the tests that failed with their cases."""
    tests = ", ".join(f"{name} ({cases})" for name, cases in failing.items())
    verdict = "SURVIVED" if set(mutation.tests) - set(failing) else "noticed"
    return f"{verdict}: {mutation.name}: {tests or 'no test fails'}"


def main() -> int:
    """Run all mutations, print what noticed each, and return 1 if one survived."""
    lines = []
    with repository_copy() as copy, steps("breaking", len(MUTATIONS) + 1) as bar:
        if failing := failures(copy):
            raise SystemExit(f"these fail without a mutation: {', '.join(failing)}")
        bar.advance()
        for mutation in MUTATIONS:
            lines.append(summary(mutation, failures_of(copy, mutation)))
            bar.advance(note=mutation.name)
    sys.stdout.write("\n".join([*lines, ""]))
    return int(any(line.startswith("SURVIVED") for line in lines))


if __name__ == "__main__":
    sys.exit(main())
