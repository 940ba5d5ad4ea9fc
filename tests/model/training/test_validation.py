"""Tests of the sites that are held out, and of the measures on them."""

import numpy as np
import pytest

from beers_deploy.model.convbeers import ConvBEERS
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.training.validation import Validation, split_by_site
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.sensor import Sensor

NAMES = (
    [f"village_{k:03d}.jpg" for k in range(30)]
    + [f"forest_{k:03d}.jpg" for k in range(10)]
    + ["dunes.jpg"]
)
SENSORS = Sensor.load("pleiades-degraded"), Sensor.load("pleiades-reference")


def test_whole_sites_are_held_out_the_smallest_first_in_any_order() -> None:
    training, validation = split_by_site(NAMES)
    assert sorted(training + validation) == list(range(41))
    assert {NAMES[k].split("_")[0] for k in validation} == {"dunes.jpg", "forest"}
    order = list(reversed(NAMES))
    assert {order[k] for k in split_by_site(order)[1]} == {
        NAMES[k] for k in split_by_site(NAMES)[1]
    }


def test_few_sites_are_all_trained_on() -> None:
    assert split_by_site(["a_1.jpg", "b_1.jpg"]) == ([0, 1], [])
    assert split_by_site([]) == ([], [])


@pytest.mark.parametrize("scale", [1, 2])
def test_a_new_network_is_judged_like_its_input_also_on_odd_sides_at_half_resolution(
    scale: int,
) -> None:
    scenes = [procedural_scene(side, side, np.random.default_rng(side)) for side in (303, 460, 90)]
    validation = Validation(scenes, *SENSORS)
    # The third scene is too small for a pair.
    assert len(validation.pairs) == 2
    assert all(side % 2 for side in validation.pairs[0][0].shape[-2:])
    network = ConvBEERS(Variant(1, 4, scale)).eval()
    for parameter in network.tail.parameters():
        parameter.data.zero_()
    restored = validation.restore(network)
    judged = validation.judge(restored)
    assert restored[0].shape == validation.pairs[0][0].shape[-2:]
    assert judged["psnr_db"] == judged["degraded_psnr_db"]
    assert 0.5 < judged["ssim"] < 1
    again = Validation(scenes, *SENSORS)
    assert again.judge(again.restore(network)) == judged
