"""Tests that a board's file accepts only keys and numbers that a board can have."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.constant import Limits
from beers_deploy.profiles.errors import ProfileError
from beers_deploy.profiles.shipped import target_names
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.target_limits import LIMITS
from docs.make.target_file import BUILD, KEYS
from tests.deploy.command_line import done, refused

FOREIGN = [
    ("measurement", "min_runs"),
    ("measurement", "min_time_s"),
    ("file", "opset_max"),
]
"""Keys of a host or an NPU, which are unknown keys for a DPU."""
PLACES = list[tuple[str, str]]()
for name, keys in KEYS.items():
    PLACES += [(name, key) for key in keys if (name, key) not in FOREIGN]
ANY_KEY = st.sampled_from(PLACES)
NOT_NUMBERS = ("nan", "-inf", '"16"', "true", "[]", "[1, 2, 3]", "{}", "1979-05-27")


def board(folder: Path, table: str, key: str, value: str) -> str:
    """Write the file of a board that differs from the VCK190 in one key, and return its path."""
    path = folder / "my-board.toml"
    name = "configurations.C32B3" if table == BUILD else table
    path.write_text(
        f'base = "vck190"\ndescription = "a test"\n\n[{name}]\n{key} = {value}\n', encoding="utf-8"
    )
    return str(path)


@st.composite
def outside(draw: st.DrawFn, limits: Limits) -> float:
    """Draw a number that the key cannot have: too small, too large, or a fraction of a count."""
    kinds = [
        st.floats(-1e300, limits.low, exclude_max=True),
        st.floats(limits.high, 1e300, exclude_min=True),
    ]
    if limits.whole:
        kinds.append(st.integers(int(limits.low), 1000).map(lambda integer: integer + 0.5))
    return draw(st.one_of(kinds))


def refusal(folder: Path, table: str, key: str, value: str) -> str:
    """Return the message that refuses the board, which names its file."""
    with pytest.raises(ProfileError, match="my-board") as caught:
        TargetProfile.load(board(folder, table, key, value))
    return str(caught.value)


@given(data=st.data(), place=ANY_KEY)
def test_a_number_that_no_board_has_is_refused(
    data: st.DataObject, place: tuple[str, str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    value = data.draw(outside(LIMITS[place[1]]))
    for text in (f"{value!r}", f"[{min(value, 1.0)!r}, {max(value, 1.0)!r}]"):
        message = refusal(tmp_path_factory.mktemp("board"), *place, text)
        assert place[1] in message
        assert f"{value:.12g}" in message
        assert message.isprintable()


@given(place=ANY_KEY, value=st.sampled_from(NOT_NUMBERS))
def test_a_value_that_is_no_number_is_refused(
    place: tuple[str, str], value: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert place[1] in refusal(tmp_path_factory.mktemp("board"), *place, value)


@given(data=st.data(), place=ANY_KEY)
def test_every_number_within_the_limits_is_accepted(
    data: st.DataObject, place: tuple[str, str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    limits = LIMITS[place[1]]
    real = st.floats(limits.low, limits.high)
    integers = st.integers(int(limits.low), int(limits.high))
    value = float(data.draw(integers if limits.whole else real))
    profile = TargetProfile.load(board(tmp_path_factory.mktemp("board"), *place, repr(value)))
    constants = profile.configuration("C32B3")[1] if place[0] == BUILD else profile.tables[place[0]]
    assert constants[place[1]].value == value


@given(place=ANY_KEY)
def test_a_misspelt_key_or_table_is_refused_with_the_right_name(
    place: tuple[str, str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    table, key = place
    message = refusal(tmp_path_factory.mktemp("board"), table, f"{key}x", "1")
    name = "configurations.C32B3" if table == BUILD else table
    assert f"my-board.toml [{name}] has the unknown key '{key}x'; it can have the keys " in message
    assert message.endswith(f". Write {key!r}.")
    if table != BUILD:
        message = refusal(tmp_path_factory.mktemp("board"), f"{table}x", key, "1")
        assert f"my-board.toml has the unknown key '{table}x'; it can have the keys " in message
        assert message.endswith(f". Write {table!r}.")


@pytest.mark.parametrize("place", FOREIGN)
def test_a_key_of_another_device_is_refused(place: tuple[str, str], tmp_path: Path) -> None:
    message = refusal(tmp_path, *place, "5")
    assert f"has the unknown key {place[0]!r}; it can have the keys " in message
    assert place[0] not in message.partition("can have the keys ")[2]


@pytest.mark.parametrize("command", ["check --tile 64 --target", "bench --target", "profiles"])
def test_commands_refuse_such_a_board_in_the_same_words(command: str, tmp_path: Path) -> None:
    message = refusal(tmp_path, BUILD, "cpb", "2.5")
    assert "my-board.toml configurations.C32B3.cpb must be an integer of at least 1 " in message
    assert message in refused(*command.split(), board(tmp_path, BUILD, "cpb", "2.5"))


@pytest.mark.parametrize("name", target_names())
def test_shipped_targets_state_no_key_without_limits(name: str) -> None:
    target = TargetProfile.load(name)
    for table, keys in (*target.tables.items(), *target.configurations.items()):
        assert "published" in table or keys.keys() <= LIMITS.keys()


def test_a_published_figure_is_above_0(tmp_path: Path) -> None:
    assert "published_latency_ms" in refusal(tmp_path, "published_latency_ms", '"a network"', "-3")
    assert done("profiles", board(tmp_path, "published_latency_ms", '"a network"', "3"))
