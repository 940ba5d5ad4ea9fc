"""Tests of `evaluate --calibrate`: the interval of a user's network, fitted on pairs."""

from itertools import product
from pathlib import Path

import numpy as np
import onnx
import pytest

import beers_deploy as bd
from beers_deploy.model.interval_calibration import BORDER_PX
from beers_deploy.model.io.tensors import read_tensors
from beers_deploy.model.shipped import shipped_weights
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.restoration.interval import interval_of
from beers_deploy.studies.evaluation.calibrate import (
    interval_from_pairs,
    network_to_calibrate,
    write_with_interval,
)
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.verbs.evaluate import evaluate
from beers_deploy.verbs.restore import restore
from tests.deploy.studies.evaluation.small_pairs import DEGRADED, few_targets, write_pairs

SITES = "abcdef"
IMAGES = 4


def smooth_pair(name: str, seed: int, size: int = 96) -> NamedPair:
    """Return a pair whose degraded image differs from the reference by noise of 30 DN."""
    generator = np.random.default_rng(seed)
    reference = np.full((size, size), 900, np.float32)
    degraded = np.rint(reference + generator.normal(0, 30, reference.shape))
    return NamedPair(name, degraded.astype(np.float32), reference)


def pairs_of(sites: str = SITES, images: int = IMAGES) -> list[NamedPair]:
    """Return `images` pairs of each site."""
    named = [f"{site}_{frame}.tif" for site, frame in product(sites, range(images))]
    return [smooth_pair(name, seed) for seed, name in enumerate(named)]


def test_the_interval_covers_pairs_that_it_did_not_see() -> None:
    """The errors of the identity are the noise, which is 30 DN everywhere."""
    interval = interval_from_pairs(pairs_of(images=20), lambda image: image, DEGRADED)
    # Sixty images calibrate, which is enough for 95 %, but not for 99.
    assert list(interval.quantiles) == [50, 68, 80, 90, 95]
    width = interval.for_sensor(DEGRADED.nominal(), 4095.0, 90)
    new = smooth_pair("g_1.tif", 999)
    half = width.of(new.degraded, np.ones(new.degraded.shape, bool))
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    within = np.abs(new.degraded - new.reference)[inner] <= half[inner]
    # The weight of the new image raises the level by 1 / 60 of it.
    assert within.mean() == pytest.approx(0.915, abs=0.02)


def test_pairs_of_one_site_are_refused() -> None:
    with pytest.raises(ImageError, match="at least two sites"):
        interval_from_pairs(pairs_of("a"), lambda image: image, DEGRADED)


def test_a_copy_of_a_network_restores_with_the_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The copy of the user's network has an interval, and restores as the network did."""
    few_targets(monkeypatch)
    mine = tmp_path / "mine.onnx"
    network = bd.Network.load("convbeers-xs", sensor="pleiades-degraded")
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    del model.metadata_props[:]
    onnx.save(model, mine)
    folder = write_pairs(tmp_path / "pairs", pairs_of())
    copy = tmp_path / "copy.onnx"
    with pytest.raises(OptionError, match="is an input of this run"):
        evaluate(methods=f"{mine}@blind", pairs=folder, calibrate=mine)
    evaluate(methods=str(mine), pairs=folder, calibrate=copy, progress=False)
    assert list(interval_of(bd.Network.load(copy)).quantiles) == [50, 68, 80, 90]
    image = folder / "degraded" / "a_0.tif"
    options = {"sensor": "pleiades-degraded", "full_scale": 4095.0}
    restore(image, tmp_path / "a.tif", network=mine, **options)  # type: ignore[arg-type]
    restore(image, tmp_path / "b.tif", network=copy, interval=90, **options)  # type: ignore[arg-type]
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    assert (tmp_path / "b-interval.tif").exists()


def test_weights_keep_every_number(tmp_path: Path) -> None:
    source = shipped_weights("convbeers-xs")
    interval = interval_from_pairs(pairs_of(), lambda image: image, DEGRADED)
    write_with_interval(source, interval, tmp_path / "copy.safetensors")
    before, header = read_tensors(source)
    after, changed = read_tensors(tmp_path / "copy.safetensors")
    assert changed == {**header, "interval": interval.to_json()}
    assert before.keys() == after.keys()
    for name, values in before.items():
        np.testing.assert_array_equal(values, after[name])


@pytest.mark.parametrize(
    ("methods", "out", "words"),
    [
        (["degraded", "convbeers-s"], "a.onnx", "one file of a network .* got 0"),
        (["degraded", "a.onnx", "b.safetensors"], "c.onnx", "one file of a network .* got 2"),
        (["degraded", "a.safetensors"], "c.onnx", r"must end in \.safetensors"),
    ],
)
def test_one_file_of_a_network_is_calibrated(methods: list[str], out: str, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        network_to_calibrate(dict(zip(methods, methods, strict=True)), Path(out))
