from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.effects import Smear
from beers_deploy.profiles.errors import MachineError, ProfileError
from beers_deploy.profiles.instrument import noise_from_snr, snr_0_bounds
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import TABLES
from beers_deploy.profiles.shipped import sensor_names, target_names
from beers_deploy.profiles.target import TargetProfile
from tests.profiles.own_sensor import own_sensor
from tests.profiles.test_profile_files import refusal
from tests.project_files import text_of

SHIPPED = [
    "dior-high",
    "dior-medium",
    "pleiades-degraded",
    "pleiades-reference",
    "pleiades-variable",
]


def test_the_promised_profiles_are_shipped() -> None:
    assert sensor_names() == SHIPPED
    assert target_names() == ["host-cpu", "kv260", "vck190", "vek280", "vek385", "zcu102", "zcu104"]


@pytest.mark.parametrize("name", SHIPPED)
def test_every_sensor_constant_has_a_source(name: str) -> None:
    profile = Sensor.load(name)
    for key in chain.from_iterable(ways[0][0] for ways in TABLES.values()):
        assert getattr(profile, key).status in ("published", "inferred", "assumed")


@pytest.mark.parametrize("name", target_names())
def test_every_target_constant_has_a_source(name: str) -> None:
    target = TargetProfile.load(name)
    for table in (*target.tables.values(), *target.configurations.values()):
        assert "stated" not in {constant.status for constant in table.values()}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("gsd_m", "gsd", ("'gsd'", "'gsd_m'", "unit")),
        ("mtf_nyquist =", "sharpness =", ("'sharpness'", "mtf_nyquist")),
        ("value = 0.07", "value = 0.7", ("mtf_nyquist", "0.6366", "0.7")),
        ("value = 0.07", "value = [0.07, 0.03]", ("range [low, high]",)),
        ("value = 50,", "value = 90,", ("27.5 to 55", "90", "not dB")),
        ("value = 5,", "value = 2.5,", ("oversampling", "integer of at least 1", "2.5")),
        ("[mtf]", "[mtf", ("TOML",)),
        (
            "[noise]",
            "mtf_nyquist_vertical = 0.05\n[noise]",
            ("mtf_nyquist_vertical", "mtf_nyquist_along"),
        ),
        (
            "[noise]",
            "mtf_nyquist_along = 0.5\n[antialias]\nsigma_px = 0.4\n[noise]",
            ("mtf_nyquist_along", "at most"),
        ),
        ('"paper, table 1: L0, in W/m2/sr/um"', '""', ("source",)),
    ],
)
def test_a_wrong_file_gets_one_sentence(
    old: str, new: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    refusal(own_sensor(tmp_path, (old, new)), *words)


def test_the_track_may_have_a_contrast_of_its_own(tmp_path: Path) -> None:
    both = Sensor.load(
        own_sensor(tmp_path, ("[noise]", "mtf_nyquist_along = [0.03, 0.05]\n[noise]"))
    )
    one = Sensor.load("pleiades-degraded")
    assert both.nominal().mtf_axes == pytest.approx((0.07, 0.04))
    assert one.nominal().mtf_axes == (0.07, 0.07)
    assert one.nominal() == replace(both.nominal(), mtf_nyquist_along=None)
    draws = [both.draw(np.random.default_rng(seed)) for seed in range(40)]
    assert all(0.03 <= sensor.mtf_axes[1] <= 0.05 for sensor in draws)
    assert len({sensor.mtf_axes[1] for sensor in draws}) == 40


@given(st.integers(1, 16), st.floats(0, 65535))
def test_an_offset_that_saturates_every_pixel_is_refused(bits: int, offset_dn: float) -> None:
    fields = {"bits": bits, "effects": {"offset": {"offset_dn": offset_dn}}}
    sensor = Sensor.load("pleiades-degraded")
    largest_dn = 2**bits - 1
    if offset_dn < largest_dn:
        assert sensor.with_fields(**fields).nominal().offset_dn == offset_dn
        return
    with pytest.raises(ProfileError, match=f"below {largest_dn}, .* it is {offset_dn:g}\\."):
        sensor.with_fields(**fields)


def test_missing_profiles_and_files(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="pleiades-degraded"):
        Sensor.load("hubble")
    with pytest.raises(ProfileError, match="No such file"):
        Sensor.load(tmp_path / "none.toml")
    (tmp_path / "empty.toml").touch()
    with pytest.raises(ProfileError, match="'description'"):
        Sensor.load(tmp_path / "empty.toml")


def test_a_bare_number_is_the_users_own_statement(tmp_path: Path) -> None:
    entry = '{ value = 0.07, status = "published", source = "paper, table 1: Sim-Degraded-Fixed" }'
    constant = Sensor.load(own_sensor(tmp_path, (entry, "0.08"))).mtf_nyquist
    assert (constant.value, constant.status) == (0.08, "stated")


@given(st.sampled_from(SHIPPED), st.integers(0, 2**32))
def test_every_draw_is_physical_and_within_its_ranges(name: str, seed: int) -> None:
    profile = Sensor.load(name)
    sensor = profile.draw(np.random.default_rng(seed))
    assert sensor.alpha >= 0
    assert sensor.beta >= 0
    assert profile.mtf_nyquist.low <= sensor.mtf_nyquist <= profile.mtf_nyquist.high
    for radiance, snr in zip(
        (profile.radiance_0, profile.radiance_1), profile.snr_pair, strict=True
    ):
        ratio = radiance.low / sensor.noise_sigma(radiance.low)
        assert snr.low * (1 - 1e-9) <= ratio <= snr.high * (1 + 1e-9)
    assert sensor == profile.draw(np.random.default_rng(seed))


def test_impossible_pairs_are_counted() -> None:
    profile = Sensor.load("dior-high")
    rng = np.random.default_rng(0)
    rejected = sum(profile.draw_counted(rng)[1] for _ in range(400))
    share = rejected / (rejected + 400)
    # 24.9 % of the drawn pairs are valid.
    assert 0.70 < share < 0.80


@given(st.floats(10, 200), st.floats(0.0, 1.0))
def test_bounds_are_where_a_coefficient_changes_sign(snr_1: float, share: float) -> None:
    low, high = snr_0_bounds(25, 100, snr_1)
    alpha, beta = noise_from_snr(25, low + share * (high - low), 100, snr_1)
    assert alpha >= -1e-12
    assert beta >= -1e-9
    assert noise_from_snr(25, low * 0.99, 100, snr_1)[0] < 0
    assert noise_from_snr(25, high * 1.01, 100, snr_1)[1] < 0


def with_table(folder: Path, table: str) -> Path:
    return own_sensor(
        folder, text=f"{text_of('profiles/sensors/pleiades-reference.toml')}\n{table}"
    )


def test_a_table_adds_its_effect(tmp_path: Path) -> None:
    profile = Sensor.load(with_table(tmp_path, "[smear]\nlength_px = [0.2, 0.4]\n"))
    smears = [profile.draw(np.random.default_rng(s)).effects["smear"] for s in range(5)]
    lengths = {effect.length_px for effect in smears if isinstance(effect, Smear)}
    assert len(lengths) == 5
    assert all(0.2 <= length <= 0.4 for length in lengths)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("[antialias]\nsigma_px = 0.5\n", ("0.1854", "anti-alias", "0.25")),
        ("[smear]\nlength = 0.2\n", ("'length'", "length_px")),
        ("[clouds]\ncover = 0.5\n", ("'clouds'",)),
    ],
)
def test_a_wrong_effect_gets_one_sentence(
    table: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    refusal(with_table(tmp_path, table), *words)


def test_the_units_of_another_sensor_bring_its_offset_and_no_other_effect(tmp_path: Path) -> None:
    own = Sensor.load(with_table(tmp_path, "[smear]\nlength_px = 0.5\n"))
    other = Sensor.load(
        with_table(tmp_path, "[smear]\nlength_px = 2\n[prnu]\nrms = 0.1\n[offset]\noffset_dn = 64")
    )
    for instrument in (
        own.in_units_of(other).nominal(),
        own.nominal().in_units_of(other.nominal()),
    ):
        assert (instrument.smear_px, instrument.offset_dn, set(instrument.effects)) == (
            0.5,
            64,
            {"smear", "offset"},
        )


def test_noise_in_both_ways_is_refused_by_replace() -> None:
    with pytest.raises(ProfileError, match="noise must have snr_0 and snr_1, or alpha and beta"):
        Sensor.load("pleiades-degraded").replace(alpha=1.0, snr_0=3.0)


def test_a_number_that_defines_the_pixels_may_not_be_a_range() -> None:
    with pytest.raises(ProfileError, match="must be one number, but it is the range 10 to 12"):
        Sensor.load("pleiades-degraded").replace(bits=(10, 12))


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
def test_a_number_of_numpy_replaces_one_of_a_sensor(kind: type) -> None:
    sensor = Sensor.load("pleiades-degraded").replace(snr_1=kind(100), snr_0=(kind(40), kind(45)))
    assert sensor.snr_pair[1].value == 100
    assert sensor.snr_pair[0].value == (40, 45)


@pytest.mark.parametrize("kind", [Sensor, TargetProfile])
def test_equal_profiles_have_one_hash(kind: type[Sensor] | type[TargetProfile]) -> None:
    """A profile is a value, which users put into sets and take as keys."""
    names = sensor_names() if kind is Sensor else target_names()
    assert len({kind.load(name) for name in names * 2}) == len(names)


def test_a_sensor_is_saved_into_a_new_folder_or_refused_in_a_sentence(tmp_path: Path) -> None:
    controls = "".join(map(chr, [*range(32), 0x7F, 0x85, 0x2028]))
    sensor = replace(Sensor.load("pleiades-degraded"), description=f'"\\ {controls}')
    assert Sensor.load(sensor.save(tmp_path / "new" / f"{sensor.name}.toml")) == sensor
    with pytest.raises(MachineError, match="cannot be written"):
        sensor.save(tmp_path)
