"""Tests that the host part encodes without a loss, and that its description is complete."""

import json
from itertools import product
from typing import Any

import numpy as np
import pytest

from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.graph import Shuffle
from beers_deploy.quant.host_part import (
    BANK_SLICES,
    IMAGE_SLICES,
    BankSum,
    Direct,
    DualRange,
    HostPart,
    InputEncoding,
    OffsetWindows,
    OutputDecoding,
    Plain,
    host_part_from_json,
    host_part_to_json,
)

SHUFFLE = Shuffle("shuffle", "a", "b", 2)
ENCODINGS: tuple[InputEncoding, ...] = (IMAGE_SLICES, Direct())
DECODINGS: tuple[OutputDecoding, ...] = (
    Plain(),
    DualRange(),
    OffsetWindows(((0.5, -1.0, 2.0),) * 2),
)
PLAIN_PARTS = [
    HostPart(4, 3, back=(SHUFFLE,), adds_image=False, encoding=encoding, decoding=decoding)
    for encoding, decoding in product(ENCODINGS, DECODINGS)
]
BANK_PARTS = [
    HostPart(unit=0.25, encoding=BANK_SLICES, decoding=BankSum(coarse_copies=count))
    for count in (0, 1)
]


def described(part: HostPart) -> dict[str, Any]:
    """Return a host part's description as a file holds it."""
    description: dict[str, Any] = json.loads(json.dumps(host_part_to_json(part)))
    return description


@pytest.mark.parametrize("part", [*PLAIN_PARTS, *BANK_PARTS], ids=repr)
def test_a_description_states_the_whole_host_part(part: HostPart) -> None:
    assert host_part_from_json(described(part)) == part


@pytest.mark.parametrize(
    "damage",
    [
        {"outputs": None},
        {"front": 3},
        {"margin_px": -1},
        {"input_ranges": [[0, 2], [0, 1]]},
        {"input_ranges": [[1.0, 0.0]]},
        {"input_ranges": [[0.0, float("nan")]]},
        {"input_ranges": [[0.0, 1e9]]},
        {"input_ranges": [[0.0, 2.0]] * 2},
        {"input_ranges": [[0.0]]},
        {"input_ranges": 3},
        {"limits": [1.0, 0.0]},
        {"limits": [1.0]},
        {"limits": [0.0, float("inf")]},
        {"planes": 5},
        {"planes": None},
        {"gains": 0},
        {"activation": "Exp"},
        {"base": {"factor": 0}},
        {"base": {"channels": [1]}},
        {"base": {"factor": "twice"}},
        {"crop_px": -1},
    ],
)
def test_a_damaged_description_is_refused(damage: dict[str, Any]) -> None:
    """Files may come from anybody, so the reader trusts none of their numbers."""
    with pytest.raises((TypeError, ValueError)):
        host_part_from_json(described(HostPart()) | damage)


@pytest.mark.parametrize("slices", [IMAGE_SLICES, BANK_SLICES], ids=["image", "bank"])
def test_bit_slices_hold_every_digital_number(slices: Any) -> None:
    dn = np.arange(MAX_DN + 1)
    planes = slices.encode((dn / np.float32(MAX_DN)).astype(np.float32)[None, None, None])
    *_, coarse, remainder, part = planes[0, :, 0].astype(int)
    np.testing.assert_array_equal(slices.step * coarse + remainder + slices.middle, dn)
    assert np.abs(slices.part * part - remainder).max() <= slices.part / 2
    low, high = slices.limits
    assert planes.min() == min(low)
    assert planes.max() == max(high)
