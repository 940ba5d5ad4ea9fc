"""Write docs/explanation/mutations.md: `python docs/make/mutations.py` breaks a copy of this code
ten times.

It takes some minutes. Each time one or two lines of the product change, as
docs/explanation/mutations.toml says, and the files of stability tests that it names run on the
copy. The tests named there must fail; unbroken, every one must pass. Exit code 1 when a broken
version survives. A test keeps the list true to the code.
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
LIST = ROOT / "docs" / "explanation" / "mutations.toml"
TARGET = ROOT / "docs" / "explanation" / "mutations.md"
SUITE = "tests/stability"
PROBE_FILE = "test_copy.py"
FAILED = re.compile(r"^(?:FAILED|ERROR) \S+/(\w+\.py::\w+)", re.MULTILINE)
PROBE = """
from pathlib import Path
import beers_deploy
from beers_deploy import model, profiles, quant

def test_the_copy_is_what_runs():
    here = Path(__file__).resolve().parents[2]
    assert {Path(each.__file__).resolve().parents[1] for each in (beers_deploy, model, profiles, quant)} == {here}
"""

Failures = Mapping[str, int]
"""Of each test that failed, `file::function`, the number of its cases that did."""


@dataclass(frozen=True)
class Mutation:
    """One way to break the product, see docs/explanation/mutations.toml."""

    name: str
    meaning: str
    file: str
    changes: list[tuple[str, str]]
    tests: list[str]


MUTATIONS = tuple(
    Mutation(**entry) for entry in tomllib.loads(LIST.read_text(encoding="utf-8"))["mutation"]
)

OPENING = """# Broken on purpose

    python docs/make/mutations.py

makes ten copies of this code, changes one or two lines of each as [mutations.toml](mutations.toml) says, and runs
stability tests on them. Every test passes on the unchanged code. The table names the tests of `tests/stability` that
failed for each change, with the number of cases in parentheses.
"""


def broken(text: str, mutation: Mutation) -> str:
    """Return the text of a file with the mutation.

    Raises:
        SystemExit: what should change does not stand there just once.
    """
    for old, new in mutation.changes:
        if text.count(old) != 1:
            raise SystemExit(
                f"{mutation.name}: in {mutation.file} `{old}` stands {text.count(old)} times, "
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
    listed = subprocess.check_output(command, cwd=ROOT, text=True)  # noqa: S603 - the developer's own git
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
        SystemExit: they could not be run, or ran somebody else's code.
    """
    names = set[str]().union(*(mutation.tests for mutation in MUTATIONS))
    files = {name.partition("::")[0] for name in names}
    paths = [f"{SUITE}/{name}" for name in sorted({PROBE_FILE, *files})]
    options = ["-n0", "-pno:cacheprovider", "--tb=no", "-q", "-rfE", "--hypothesis-seed=0"]
    process = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "pytest", *paths, *options],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if process.returncode not in (0, 1):
        raise SystemExit(process.stdout + process.stderr)
    tests = Counter(FAILED.findall(process.stdout))
    if any(name.startswith(PROBE_FILE) for name in tests):
        raise SystemExit(f"not the code of {copy} is what runs there")
    return tests


def document(failures_by: Mapping[str, Failures]) -> str:
    """Return the page as Markdown."""
    lines = [OPENING, "| mutation | file | tests that fail |", "|---|---|---|"]
    for mutation in MUTATIONS:
        tests = ", ".join(
            f"`{name}` ({cases})" for name, cases in failures_by[mutation.name].items()
        )
        lines.append(f"| {described(mutation)} | {tests or 'none'} |")
    return "\n".join([*lines, ""])


def described(mutation: Mutation) -> str:
    """Return the two cells that describe the change."""
    return f"**{mutation.name}**: {mutation.meaning} | `{mutation.file}`"


def main() -> int:
    """Run all mutations, write the page, and print those that survived."""
    by_mutation = {}
    with repository_copy() as copy, steps("breaking", len(MUTATIONS) + 1) as bar:
        if failing := failures(copy):
            raise SystemExit(f"unbroken, these fail: {', '.join(failing)}")
        bar.advance()
        for mutation in MUTATIONS:
            by_mutation[mutation.name] = failures_of(copy, mutation)
            bar.advance(note=mutation.name)
    TARGET.write_text(document(by_mutation), encoding="utf-8", newline="\n")
    print(f"wrote {TARGET}")
    survivors = [m.name for m in MUTATIONS if set(m.tests) - set(by_mutation[m.name])]
    for name in survivors:
        print(f"SURVIVED: {name}")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
