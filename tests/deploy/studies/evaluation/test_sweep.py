"""Tests of the conditions of a sweep: which sensor each method is given, and the loss of a chain
that is given the wrong one.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.figures import Row, by_table, unavailable
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.restoration.method import Restore
from beers_deploy.studies.evaluation import sweep as module
from beers_deploy.studies.evaluation.methods import BLIND, Method
from beers_deploy.studies.evaluation.sweep import (
    NOMINAL_KNOWN,
    TRUTH_KNOWN,
    Key,
    SweepResult,
    conditions,
    run_sweep,
    suppositions,
)
from tests.deploy.command_line import done
from tests.deploy.documents import valid
from tests.deploy.studies.evaluation.small_pairs import DEGRADED, REFERENCE, few_targets

NOMINAL = DEGRADED.nominal()
DRIFTED = replace(NOMINAL, mtf_nyquist=0.03)
DIM = replace(NOMINAL, gain_dn_per_radiance=0.7 * NOMINAL.gain_dn_per_radiance)

WRONG = "MTF 3%, supposed MTF 7%"
WRONGLY = "sweep, sensor known wrongly", "sweep, lost by a sensor known wrongly"


def test_a_sensor_supposed_wrongly_is_not_the_one_of_the_condition() -> None:
    sensors = conditions(NOMINAL, DEGRADED)
    assert len(sensors) == 16
    for truth, supposed in suppositions(NOMINAL, DEGRADED).items():
        assert sensors[truth] not in supposed.values()
    noisy = suppositions(NOMINAL, DEGRADED)["nominal"].values()
    for factor, sensor in zip((4 / 3, 2 / 3), noisy, strict=True):
        for radiance in (25, 100):
            ratio = NOMINAL.noise_sigma(radiance) / sensor.noise_sigma(radiance)
            assert ratio == pytest.approx(factor)


Swept = tuple[dict[str, dict[str, Row]], list[Instrument]]


def half(dn: np.ndarray) -> np.ndarray:
    return dn / 2


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Sweep three conditions only, on small targets that are acquired once."""
    with pytest.MonkeyPatch.context() as patch:
        few_targets(patch)
        three = {"nominal": NOMINAL, "MTF 3%": DRIFTED, "dim": DIM}
        patch.setattr(module, "conditions", lambda _nominal, _profile: three)
        yield


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Swept:
    """Return the rows of a sweep, and the sensors that the able network was given."""
    specialised: list[Instrument] = []

    def specialise(sensor: Instrument) -> Restore:
        specialised.append(sensor)
        return lambda dn: dn + np.float32(1000 * sensor.mtf_nyquist)

    able = Method("able", half, BLIND, specialise)
    folder = tmp_path_factory.mktemp("scenes")
    scene = procedural_scene(500, 560, np.random.default_rng(5))
    tifffile.imwrite(folder / "scene.tif", scene.radiance)
    rows = run_sweep([Method("half", half, BLIND), able], folder, DEGRADED, REFERENCE, 0).rows
    return {
        table: {row.name: row for row in rows} for table, rows in by_table(rows).items()
    }, specialised


def psnr(swept: Swept, condition: str) -> Callable[[str], float]:
    return lambda method: swept[0]["sweep, PSNR"][condition].figures[method].value or 0.0


def test_a_network_that_accepts_a_sensor_is_given_that_of_each_condition(swept: Swept) -> None:
    """It is then given the supposed sensors. It never restores without a given sensor."""
    supposed_for = suppositions(NOMINAL, DEGRADED)
    supposed = [list(supposed_for[name].values()) for name in ("nominal", "MTF 3%")]
    assert swept[1] == [NOMINAL, *supposed[0], DRIFTED, *supposed[1], DIM]
    at = psnr(swept, "nominal")
    assert at("half") < at("able") - 3


def test_knowing_the_true_sensor_helps_where_it_has_drifted(swept: Swept) -> None:
    """The reference has the gain of the input, so methods that ignore gains keep the brightness."""
    nominal = psnr(swept, "nominal")
    drifted = psnr(swept, "MTF 3%")
    dim = psnr(swept, "dim")
    assert nominal(TRUTH_KNOWN) == nominal(NOMINAL_KNOWN)
    assert drifted(TRUTH_KNOWN) > drifted(NOMINAL_KNOWN) + 1
    assert nominal("half") < nominal("degraded") - 5
    assert dim(NOMINAL_KNOWN) == dim(TRUTH_KNOWN)
    assert dim("degraded") == pytest.approx(nominal("degraded") + 3.1, abs=0.5)


def test_a_wrong_sensor_costs_the_methods_that_accept_one(swept: Swept) -> None:
    scores, losses = (swept[0][name] for name in WRONGLY)
    assert (
        list(scores)
        == list(losses)
        == ["nominal, supposed SNR x 1.33", "nominal, supposed SNR x 0.67", WRONG]
    )
    assert list(scores[WRONG].figures) == ["traditional", "able"]
    assert (losses[WRONG].figures["traditional"].value or 0) > 1


SITES = ["a", "b", "c", "d", "e", "f"]


def synthetic_sweep() -> SweepResult:
    """Return scores of sites that differ by 20 dB, with a small gain of the network over the chain.

    The gain is equal at all sites under one condition, and differs a little under the other.
    """
    site = np.linspace(30, 50, len(SITES))
    lead = {"nominal": np.full(6, 0.75), "MTF 3%": np.linspace(0.1, 0.5, 6)}
    psnr: dict[Key, np.ndarray] = {}
    for truth, ahead in lead.items():
        levels = {"degraded": site - 8, "traditional": site, "net": site + ahead}
        psnr |= {
            Key(truth, truth, name): np.stack([level, level + 1]) for name, level in levels.items()
        }
    psnr[Key("MTF 3%", "nominal", "traditional")] = np.stack([site - 2, site - 2])
    psnr[Key("MTF 3%", "MTF 7%", "net")] = np.stack([site - 1, site - 1])
    return SweepResult(psnr, dict.fromkeys(psnr, unavailable("%", "no edges here")), SITES, 0)


def test_gains_and_losses_are_those_of_differences_on_the_same_images() -> None:
    tables = by_table(synthetic_sweep().rows)
    noisy, clean = (
        tables[f"sweep, PSNR{end}"][0].figures["net"].value or 0
        for end in ("", ", reference without noise")
    )
    assert clean - noisy == pytest.approx(1)
    nominal, blurred = (row.figures["net"] for row in tables["sweep, gain over the pipeline"])
    assert nominal.value == pytest.approx(0.75)
    assert nominal.interval == pytest.approx((0.75, 0.75))
    assert blurred.interval is not None
    assert 0.1 <= blurred.interval[0] < (blurred.value or 0) < blurred.interval[1] <= 0.5
    (row,) = tables["sweep, gain over the pipeline, all conditions"]
    assert row.name == "net"
    assert row.figures["mean of 2 conditions"].value == pytest.approx((0.75 + 0.3) / 2)
    assert row.figures["least"].value == pytest.approx(0.3)
    assert row.text == {"least at": "MTF 3%"}
    (row,) = tables["sweep, lost by a sensor known wrongly"]
    assert row.name == "MTF 3%, supposed MTF 7%"
    assert row.figures["net"].value == pytest.approx(1.3)
    assert row.figures["net"].interval is not None
    assert row.figures["net"].interval[1] - row.figures["net"].interval[0] < 0.5


def test_the_command_sweeps_the_networks_alone_at_each_brightness(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "conditions", lambda nominal, _: {"nominal": nominal})
    scene = np.random.default_rng(0).integers(200, 1800, (300, 340)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "scene.tif", scene)
    document = tmp_path / "found.json"
    methods = "degraded,convbeers-xs"
    files = ("--images", tmp_path, "--json", document)
    done("evaluate", *files, "--methods", methods, "--sweep", "--brightness", 0.1)
    swept = {row["table"]: row for row in valid(document)["rows"] if row["name"] == "nominal"}
    bright, dim = (swept[f"sweep, PSNR{end}"]["figures"] for end in ("", ", radiance x 0.1"))
    assert set(bright) >= {NOMINAL_KNOWN, TRUTH_KNOWN, "convbeers-xs"}
    assert "sweep, MTF at Nyquist" in swept
    assert "sweep, MTF at Nyquist, radiance x 0.1" not in swept
    assert dim["degraded"]["value"] > bright["degraded"]["value"] + 5
