"""Tests that pages, links, keys, terms and versions in the project's files exist and agree."""

import re
import subprocess
import tomllib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from beers_deploy import __version__
from beers_deploy.cli.commands import COMMANDS
from beers_deploy.profiles.effects import TABLES
from beers_deploy.profiles.scene_call import SceneCall
from beers_deploy.profiles.shipped import board_names, scene_names
from beers_deploy.profiles.target import TargetProfile
from docs.make import api, commands, operators, target_file
from tests.project_files import ROOT, text_of

PATH = re.compile(r"(?<![\w/.-])docs/[\w./-]*\w\.(?:md|py|toml|svg|png|ipynb)\b")
LINK = re.compile(r"\]\((?!https?:|data:|#)([^)#\s]+)")
TERMS = (
    "halo",
    "known sensor",
    "DPU",
    "MTF",
    "residual group",
    "encoding",
    "gate",
    "swath",
    "haze",
    "front",
)


def tracked() -> list[Path]:
    command = ["git", "ls-files", "-z"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    texts = (".md", ".py", ".toml", ".yml", ".cff", ".html", ".ipynb")
    return [ROOT / name for name in names.split("\0") if name.endswith(texts) or name == ".ci/run"]


def test_pages_that_files_mention_exist() -> None:
    mentions = set[tuple[Path, str]]()
    for path in tracked():
        if path.name != Path(__file__).name:
            words = PATH.findall(path.read_text(encoding="utf-8"))
            mentions |= {(path.relative_to(ROOT), word) for word in words}
    assert len(mentions) > 100
    assert [
        (str(path), word) for path, word in sorted(mentions) if not (ROOT / word).exists()
    ] == []


@pytest.mark.parametrize(
    "name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "model/weights/convbeers-s.md"]
)
def test_links_of_pages_outside_the_site_lead_to_files(name: str) -> None:
    page = ROOT / name
    targets = LINK.findall(page.read_text(encoding="utf-8"))
    assert targets
    assert [target for target in targets if not (page.parent / target).exists()] == []


@pytest.mark.parametrize(
    ("maker", "document"),
    [
        (api, api.document),
        (commands, commands.reference),
        (operators, operators.document),
        (target_file, target_file.document),
    ],
    ids=lambda page: page.__name__,
)
def test_a_generated_page_is_fresh(maker: Any, document: Callable[[], str]) -> None:
    assert maker.TARGET.read_text(encoding="utf-8") == document(), f"run python {maker.__file__}"


def test_the_page_explains_exactly_the_keys_of_the_boards() -> None:
    shipped = defaultdict[str, set[str]](set)
    for board in map(TargetProfile.load, board_names()):
        for table, constants in board.tables.items():
            shipped[table] |= {*constants}
        for configuration in board.configurations.values():
            shipped[target_file.BUILD] |= {*configuration}
    assert {table: {*keys} for table, keys in target_file.KEYS.items()} == shipped


def test_the_page_of_scenes_is_correct_and_its_example_is_a_scene(tmp_path: Path) -> None:
    page = text_of("docs/reference/scene-file.md")
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert {*tomllib.loads(example)} <= {"description", "radiance_scale", "without", *TABLES}
    assert re.findall(r"Shipped: (.*)\.", page) == [
        ", ".join(f"`{name}`" for name in scene_names())
    ]
    (tmp_path / "mine.toml").write_text(example, encoding="utf-8")
    assert SceneCall.load(str(tmp_path / "mine.toml")).without == ("striping",)


def test_the_page_of_exit_codes_names_the_commands_with_a_verdict() -> None:
    page = text_of("docs/reference/exit-codes.md")
    judging = {
        name
        for name, command in COMMANDS.items()
        if command.doc.returns
        and "true if" in " ".join(str(command.doc.returns.description).split())
    }
    assert "gate" in judging
    assert {*re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)} == judging


def test_the_glossary_has_the_terms_of_the_pages() -> None:
    page = text_of("docs/reference/glossary.md")
    terms = " ".join(re.findall(r"^- \*\*(.*?)\*\*: ", page, re.MULTILINE))
    assert [term for term in TERMS if term not in terms] == []


def test_every_number_of_the_readme_is_on_the_page_that_says_how_we_know() -> None:
    readme = text_of("README.md")
    page = text_of("docs/explanation/how-we-know.md")
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", readme, flags=re.DOTALL)
    numbers = set(re.findall(r"(?<![\w.-])\d+(?:\.\d+)*", prose))
    assert len(numbers) > 10
    assert numbers - set(re.findall(r"\d+(?:\.\d+)*", page)) == set()


def test_the_citation_and_the_changelog_have_this_version() -> None:
    project = tomllib.loads(text_of("pyproject.toml"))["project"]
    cited = dict(re.findall(r"^([\w-]+): (.+)$", text_of("CITATION.cff"), re.MULTILINE))
    assert (cited["cff-version"], cited["version"]) == ("1.2.0", __version__)
    changes = re.findall(r"^## (.*)$", text_of("CHANGELOG.md"), re.MULTILINE)
    assert changes[0] == f"{__version__} - {cited['date-released']}"
    # The package also holds the viewer's licence.
    assert project["license"].split(" AND ")[0] == cited["license"]


def test_the_workflow_of_the_site_installs_the_packages_of_the_extra() -> None:
    extra = tomllib.loads(text_of("pyproject.toml"))["project"]["optional-dependencies"]
    workflow = text_of(".github/workflows/docs.yml")
    installed = re.findall(r"pip install (.*?')(?: #.*)?$", workflow, re.MULTILINE)
    assert installed
    assert all(re.findall(r"'(.*?)'", line) == extra["docs"] for line in installed)
