"""Tests of TOML and JSON that would hang, exhaust memory or end in a traceback."""

import json
import os
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import BeersError, OptionError, ProfileError, printable
from beers_deploy.profiles.scene_call import SceneCall
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.toml import TOML_BYTES, read_toml_text
from beers_deploy.profiles.user_files.json_text import JSON_BYTES, parse_json, read_json
from beers_deploy.profiles.user_files.whole import QUOTED
from beers_deploy.quant.limits import limits_of

BAD_TOML = {
    "nested arrays": "a = " + "[" * 20_000,
    "inline tables": "a = " + "{b = " * 5_000,
    "decimal digits": "a = " + "9" * 5_000,
    "too long": "#" * (TOML_BYTES + 1),
    "no text": "a = '\x00'",
}


@pytest.mark.parametrize("name", BAD_TOML)
def test_hostile_toml_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(BAD_TOML[name])
    with pytest.raises(ValueError, match=r"."):
        read_toml_text(path)
    for load in (Sensor.load, TargetProfile.load):
        with pytest.raises(ProfileError) as caught:
            load(str(path))
        assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a = 1\nsnr_0 = 32 dB\nb = 2\n", "line 2, 'snr_0 = 32 dB': Expected newline"),
        ("a = 1\r\n\r\n  b = 1,5\r\n", "line 3, 'b = 1,5': Expected newline"),
        ("a = 1\nb = [1,\n\n", "line 2, 'b = [1,': Invalid value"),
        ("a = 1\n[noise", "line 2, '[noise': Expected"),
        ("[noise]\na = 1\n[noise]\n", "line 3, '[noise]': Cannot declare"),
        ("a = " + "b" * 1000, f"line 1, 'a = {'b' * (QUOTED - 4)}': Invalid value"),
        ("a", "line 1, 'a': Expected"),
        ("\u007f", "line 1, '\\x7f': Invalid statement"),
    ],
)
def test_the_line_that_is_no_toml_is_quoted_wherever_a_user_s_toml_is_read(
    text: str, line: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode())
    for load in (Sensor.load, TargetProfile.load, SceneCall.load, limits_of):
        with pytest.raises(BeersError) as caught:
            load(str(path))
        assert line in str(caught.value)
        assert str(caught.value).isprintable()


BAD_JSON = {
    "nested arrays": "[" * 100_000,
    "nested objects": '{"a":' * 100_000,
    "not a number": '{"a": NaN}',
    "infinity": "[-Infinity]",
    "a large number": "1e999",
    "a large whole number": "1" + "0" * 400,
    "thousands of digits": "9" * 5_000,
    "half a pair": '"\\ud800"',
    "half a pair as a key": '{"\\udc00": 1}',
    "nothing": "",
}


@pytest.mark.parametrize("name", BAD_JSON)
def test_hostile_json_is_a_value_error(name: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_json(BAD_JSON[name])


def test_a_key_that_is_there_twice_is_named() -> None:
    with pytest.raises(ValueError, match="it has the key 'b' twice"):
        parse_json('{"a": 1, "b": 2, "b": 2}')


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.text(),
        st.lists,
        max_leaves=20,
    )
)
def test_plain_values_are_read_back(value: object) -> None:
    assert parse_json(json.dumps(value)) == value


@pytest.mark.skipif(
    sys.platform == "win32", reason="Windows has no pipes and devices among its files"
)
def test_pipes_and_devices_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    for path in (tmp_path / "pipe.json", Path("/dev/zero")):
        with pytest.raises(ValueError, match="regular"):
            read_json(path)


def test_huge_files_are_not_read(tmp_path: Path) -> None:
    with (tmp_path / "huge.json").open("wb") as stream:
        stream.truncate(JSON_BYTES + 1)
    with pytest.raises(ValueError, match="more"):
        read_json(tmp_path / "huge.json")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none.json")


def test_a_message_shows_what_a_file_holds_on_one_short_line() -> None:
    content = "\x1b[2J\ud800" + "x" * 10_000
    error = OptionError(f"a\nb has {printable(content)}. Remove it.")
    assert str(error).isprintable()
    assert "\\x1b[2J\\ud800xxx" in str(error)
    assert str(error).endswith("x.... Remove it.")
    assert len(str(error)) < 600
    str(error).encode()
    assert len(str(OptionError(content))) < 2600
