"""Tests of board files, most of which name a base and state only what differs from it."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from beers_deploy.dpu.board import load_dpu
from beers_deploy.profiles.errors import BeersError, ProfileError
from beers_deploy.profiles.shipped import board_names, target_names
from beers_deploy.profiles.target import TargetProfile
from tests.deploy.command_line import done, refused
from tests.project_files import text_of

(EXAMPLE,) = re.findall(r"```toml\n(.*?)```", text_of("docs/reference/boards.md"), re.DOTALL)
VEK280 = text_of("profiles/targets/vek280.toml")


def write_board(folder: Path, text: str) -> str:
    path = folder / "my-board.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_the_boards_are_the_targets_with_a_dpu() -> None:
    assert board_names() == [
        name for name in target_names() if TargetProfile.load(name).configurations
    ]


def test_the_board_of_the_page_differs_from_the_zcu102_only_where_it_says(tmp_path: Path) -> None:
    mine = load_dpu(write_board(tmp_path, EXAMPLE))
    base = load_dpu("zcu102", "B2304")
    assert (mine.name, mine.cores, mine.batch) == ("B2304", 2, 2)
    assert mine.engine_ops_per_s == pytest.approx(2304 * 250e6)
    own_keys = {("array", "pl_clock_hz"), ("memory", "ddr_bytes_per_s"), ("tile", "memory_bytes")}
    watts = {("power", "dpu_range_w")}
    differing = set[tuple[str, str]]()
    for table, constants in base.tables.items():
        own = mine.tables[table]
        differing |= {(table, key) for key, value in constants.items() if own.get(key) != value}
    assert differing == own_keys | watts
    assert not {key for _, key in watts} & set(mine.tables["power"])
    assert mine.target.activations == base.target.activations
    assert mine.target.documents == base.target.documents


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"zcu102"', '"zcu999"', ("base", "zcu102", "'zcu999'")),
        ('"zcu102"', "3", ("base", "shipped", "got 3")),
        (
            "[tile]",
            '[activations]\nconv = ["relu"]\n[tile]',
            ("activations.conv", "ReLU6", "['relu']"),
        ),
        ("[tile]", '[activations]\nconf = ["ReLU"]\n[tile]', ("'conf'", "conv")),
        ("[tile]", '[documents]\nmanual = "mine"\n[tile]', ("'manual'", "operators")),
    ],
)
def test_a_wrong_board_gets_one_sentence(
    old: str, new: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    assert old in EXAMPLE
    with pytest.raises(ProfileError) as caught:
        load_dpu(write_board(tmp_path, EXAMPLE.replace(old, new)))
    assert "\n" not in str(caught.value)
    for word in ("my-board", *words):
        assert word in str(caught.value)


def test_a_board_without_a_base_names_its_documents(tmp_path: Path) -> None:
    without = re.sub(r"\[documents].*?\n\n", "", VEK280, flags=re.DOTALL)
    with pytest.raises(ProfileError, match=r"my-board has no table \[documents\]"):
        load_dpu(write_board(tmp_path, without))


def test_without_cost_constants_only_predictions_are_refused(tmp_path: Path) -> None:
    text = text_of("profiles/targets/vck190.toml")
    path = write_board(tmp_path, re.sub(r"\n\[cost].*?\n\n", "\n", text, flags=re.DOTALL))
    done("check", "--tile", "64", "--target", path)
    assert "no cost constants yet" in refused(
        "stress", "--bit-flips", "--target", path, "--side", "32"
    )


def test_the_refusal_of_a_target_without_a_dpu_names_the_boards() -> None:
    with pytest.raises(BeersError, match=", ".join(board_names())):
        load_dpu("host-cpu")


@pytest.mark.parametrize("name", board_names())
def test_the_name_of_a_board_s_model_stands_for_the_board(name: str) -> None:
    assert TargetProfile.load(f"{name}-model") == TargetProfile.load(name)


@pytest.mark.parametrize("command", ["check", "quantize", "gate", "stress"])
def test_the_help_names_every_board(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"})
    assert all(name in result.output for name in board_names())
