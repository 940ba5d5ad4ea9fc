"""The runner of the pages' commands notices what a reader would stumble over."""

from pathlib import Path

import pytest

from tests.docs.walk import PageError, Walk, agrees, plain

PROFILES = "```bash\nbeers-deploy profiles pleiades-degraded\n```\n"


def walk(page: str, folder: Path) -> Walk:
    made = Walk(folder)
    made.page(page)
    return made


def test_it_writes_files_and_runs_commands_in_order(tmp_path: Path) -> None:
    page = (
        '```python title="twice/say.py"\nimport sys\nprint(2 * int(sys.argv[1]), "times", file=sys.stderr)\n```\n'
        "```bash\npython twice/say.py \\\n  21\npython -c 'print(7)'\n```\n```text\n42 times\n...\n7\n```\n"
        "<!-- test: exits 3 -->\n```bash\npython -c 'raise SystemExit(3)'\n```\n"
    )
    assert [*walk(page, tmp_path).printed.values()] == ["42 times\n", "7\n", ""]


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


@pytest.mark.parametrize(
    "shown", ["a 10 b\nc 3.5 d", "a 10.1 b", "c 3.45   d", "a ... b\n...\n... 3.5 d", "...\nc ..."]
)
def test_what_it_shows_may_be_shortened(shown: str, tmp_path: Path) -> None:
    walk(f"{SAY}```text\n{shown}\n```\n", tmp_path)


@pytest.mark.parametrize("shown", ["a 11 b", "a 10", "c 3.5 d\na 10 b", "a 10 b\na 10 b", "a 10 b c 3.5 d"])
def test_what_it_shows_must_be_printed_so_and_in_this_order(shown: str, tmp_path: Path) -> None:
    with pytest.raises(PageError, match="not in this place"):
        walk(f"{SAY}```text\n{shown}\n```\n", tmp_path)


def test_figures_that_vary_are_compared_by_their_place_for_one_output_alone(tmp_path: Path) -> None:
    vary = f"{SAY}<!-- test: figures vary -->\n```text\na 77 b\n```\n"
    walk(vary, tmp_path)
    with pytest.raises(PageError, match="a 77 b"):
        walk(f"{vary}```text\na 77 b\n```\n", tmp_path)
    with pytest.raises(PageError, match="a b"):
        walk(f"{SAY}<!-- test: figures vary -->\n```text\na b\n```\n", tmp_path)


def test_substitutions_are_made_and_must_be_of_use(tmp_path: Path) -> None:
    shorter = "<!-- test: print(7) -> print(8) -->\n"
    page = "```bash\npython -c 'print(7)'\n```\n"
    assert walk(shorter + page, tmp_path).printed == {"python -c 'print(7)'": "8\n"}
    with pytest.raises(PageError, match="print"):
        walk(page + shorter, tmp_path)
    with pytest.raises(PageError, match="no such comment"):
        walk("<!-- test: skipped -->\n" + page, tmp_path)


@pytest.mark.parametrize("comment", ["exits 1", "figures vary"])
def test_a_comment_that_nothing_follows_is_refused(comment: str, tmp_path: Path) -> None:
    with pytest.raises(PageError, match="no command or output"):
        walk(f"{SAY}<!-- test: {comment} -->\n", tmp_path)


def test_tables_agree_whatever_the_width_of_their_columns() -> None:
    assert plain("┏━━━┳━┓\n│ a   │ 1 │\n\n")[:2] == plain(" ┏━┳━━━━━┓ \n│ a │   1 │")
    assert agrees("│ time │ 2,620 [2,370, 2,670] │", "│ time │ 2,600 [2,370, 2,671] │", vary=False)
    assert not agrees("│ time │ 2,620 [2,370, 2,670] │", "│ time │ 2,400 [2,370, 2,671] │", vary=False)
    assert not agrees("vck190 C32B3", "vck190 C32B6", vary=True)
