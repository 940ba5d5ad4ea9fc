"""The runner of the pages' commands notices what a reader would stumble over."""

from pathlib import Path

import pytest

from tests.docs.walk import PageError, Walk

PROFILES = "```bash\nbeers-deploy profiles pleiades-degraded\n```\n"


def walk(page: str, folder: Path) -> Walk:
    made = Walk(folder)
    made.page(page)
    return made


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("profiles", "profile", "ended with 2"),
        ("pleiades-degraded", "pleiades-degraded --no-such-option", "ended with 2"),
        ("pleiades-degraded", "pleiades-degarded", "ended with 2"),
        ("beers-deploy", "echo beers-deploy", "is no command of"),
        ("```bash", "<!-- test: exits 1 -->\n```bash", "ended with 0, not 1"),
    ],
)
def test_a_wrong_command_fails(right: str, wrong: str, complaint: str, tmp_path: Path) -> None:
    walk(PROFILES, tmp_path)
    with pytest.raises(PageError, match=complaint):
        walk(PROFILES.replace(right, wrong), tmp_path)


SAY = '```bash\npython -c \'print("a 10 b"); print("c 3.50 d")\'\n```\n'


@pytest.mark.parametrize("shown", ["a 11 b", "a 10", "c 3.5 d\na 10 b", "a 10 b\na 10 b", "a 10 b c 3.5 d"])
def test_what_it_shows_must_be_printed_so_and_in_this_order(shown: str, tmp_path: Path) -> None:
    with pytest.raises(PageError, match="not in this place"):
        walk(f"{SAY}```text\n{shown}\n```\n", tmp_path)
