"""Tests that each mistake in a profile is refused in one sentence that says what to do."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ProfileError
from beers_deploy.profiles.instrument import noise_from_snr, snr_0_bounds
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import TABLES
from beers_deploy.profiles.target import TargetProfile
from tests.profiles.own_sensor import SHIPPED, own_sensor

KEYS: list[tuple[str, str]] = []
for name, ways in TABLES.items():
    KEYS += product([name], ways[0][0])


def refusal(path: Path, *words: str) -> str:
    """Return the error message; check that it names the file, has `words` and ends in one stop."""
    with pytest.raises(ProfileError) as caught:
        Sensor.load(path)
    message = str(caught.value)
    for word in ("mine", *words):
        assert word in message
    assert message.endswith(".")
    assert message.isprintable()
    assert not message.endswith(("..", " .", ":."))
    return message


@pytest.mark.parametrize(("table", "key"), KEYS)
def test_a_missing_key_is_named_with_its_table(table: str, key: str, tmp_path: Path) -> None:
    lines = [line for line in SHIPPED.splitlines() if not line.startswith(f"{key} =")]
    assert f"mine.toml {table} has no key {key!r}" in refusal(
        own_sensor(tmp_path, text="\n".join(lines))
    )


@pytest.mark.parametrize(
    "value",
    ["-1", "-0.07", "1e-200", "nan", "inf", "true", "[]", "[0.01, 0.02, 0.03]", '"7 %"', "1" * 400],
)
def test_an_mtf_that_is_no_contrast_is_refused(value: str, tmp_path: Path) -> None:
    message = refusal(own_sensor(tmp_path, ("value = 0.07", f"value = {value}")))
    assert "mine.toml mtf.mtf_nyquist must " in message


def test_text_that_is_not_unicode_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"description = '\xff\xfe'")
    assert "TOML" in refusal(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("value = 10.2375", "value = [5.0, 10.0]"),
        ("value = 12,", "value = [8, 12],"),
        ("value = 25,", "value = [25, 30],"),
        ("value = 100,", "value = [90, 110],"),
    ],
)
def test_a_range_is_drawn_from_or_refused(old: str, new: str, tmp_path: Path) -> None:
    """A range must not be accepted and then silently cut to its lower end."""
    try:
        profile = Sensor.load(own_sensor(tmp_path, (old, new)))
    except ProfileError:
        return
    sensors = [profile.draw(np.random.default_rng(seed)) for seed in range(8)]
    assert any(sensor != sensors[0] for sensor in sensors)


@pytest.mark.parametrize(
    ("snr_0", "snr_1"), [(55.0, 110.0), (27.5, 110.0), (34.3, 68.6), (13.7, 27.4), (83.2, 166.4)]
)
def test_a_profile_at_the_bounds_of_the_snr_can_be_drawn(
    snr_0: float, snr_1: float, tmp_path: Path
) -> None:
    """At a bound, alpha or beta is 0, and rounding could make it slightly negative."""
    assert snr_0 in snr_0_bounds(25, 100, snr_1)
    path = own_sensor(
        tmp_path, ("value = 50,", f"value = {snr_0},"), ("value = 110,", f"value = {snr_1},")
    )
    sensor = Sensor.load(path).draw(np.random.default_rng(0))
    assert sensor.alpha >= 0
    assert sensor.beta >= 0
    assert 25 / sensor.noise_sigma(25) == pytest.approx(snr_0)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("offset = 3", "offset must be a table, got 3. Write it as [offset]."),
        (
            "veil = { transmitance = 1 }",
            (
                "veil has the unknown key 'transmitance'; it can have the keys path_radiance, "
                "transmittance. Write 'transmittance'."
            ),
        ),
        (
            "defects = { dead_per_million = 1 }",
            (
                "defects has no key 'hot_per_million'. Add it: a number of at least 0 and at most "
                "1e+06."
            ),
        ),
        (
            "prnu = { rms = { value = 0.1, source = 'x' } }",
            "prnu.rms has no key 'status'. Add it, such as status = \"measured\".",
        ),
    ],
)
def test_a_hint_says_what_to_write(line: str, words: str, tmp_path: Path) -> None:
    assert refusal(own_sensor(tmp_path, text=f"{line}\n{SHIPPED}")).endswith(f"mine.toml {words}")


def test_a_fault_in_a_table_of_contrasts_has_its_dotted_key(tmp_path: Path) -> None:
    nyquist = next(line for line in SHIPPED.splitlines() if line.startswith("mtf_nyquist ="))
    contrasts = 'across = { value = [1, 0.1], status = "guessed", source = "x" }'
    path = own_sensor(tmp_path, (nyquist, f"frequency = [0, 0.5]\n{contrasts}"))
    assert "mine.toml mtf.across.status must be 'published'," in refusal(path)


@given(st.floats(1, 90), st.floats(1.1, 9), st.floats(5, 300), st.floats(5, 300))
def test_noise_reproduces_any_two_points(
    radiance_0: float, factor: float, snr_0: float, snr_1: float
) -> None:
    """The noise line passes through both variances, whatever the signs of alpha and beta."""
    radiance_1 = factor * radiance_0
    alpha, beta = noise_from_snr(radiance_0, snr_0, radiance_1, snr_1)
    scale = max((radiance_0 / snr_0) ** 2, (radiance_1 / snr_1) ** 2)
    for radiance, snr in ((radiance_0, snr_0), (radiance_1, snr_1)):
        assert alpha * radiance + beta == pytest.approx(
            (radiance / snr) ** 2, rel=1e-9, abs=1e-12 * scale
        )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("'description'",)),
        ("description = 'x'\nclock = 3", ("mine.toml clock must be a table",)),
        (
            "description = 'x'\n[dpu]\nclock_mhz = { value = 333 }",
            ("dpu.clock_mhz has", "'status'"),
        ),
        (
            "description = 'x'\ndefault_configuration = 'Z'\n[configurations.A]\nn = 3",
            ("configuration 'Z'", "`dpu`: A."),
        ),
        ("description = 'x'\nconfigurations = 3", ("configurations must be a table",)),
    ],
)
def test_a_wrong_target_gets_one_sentence(
    text: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(ProfileError) as caught:
        TargetProfile.load(own_sensor(tmp_path, text=text))
    for word in ("mine", *words):
        assert word in str(caught.value)


def test_a_target_names_a_missing_constant() -> None:
    target = TargetProfile.load("vck190")
    with pytest.raises(ProfileError, match=r"vck190.*\[magic\] wand"):
        target.value("magic", "wand")
    with pytest.raises(ProfileError, match="C99"):
        target.configuration("C99")
