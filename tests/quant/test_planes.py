import numpy as np

from beers_deploy.profiles.sensor import MAX_DN
from beers_deploy.quant.graph import QUARTER, STEP, split


def test_no_digital_number_is_lost() -> None:
    dn = np.arange(MAX_DN + 1, dtype=np.float32).reshape(1, 1, 64, 64)
    planes = split(dn / np.float32(MAX_DN)).astype(np.int32)
    np.testing.assert_array_equal(STEP * planes[:, :1] + planes[:, 1:2], dn.astype(np.int32))
    assert np.abs(QUARTER * planes[:, 2:] - planes[:, 1:2]).max() <= QUARTER / 2


def test_values_beyond_the_range_are_clipped_not_wrapped() -> None:
    low, high = (split(np.full((1, 1, 1, 1), v, np.float32)).ravel().tolist() for v in (-3.0, 7.0))
    assert low == [0, 0, 0]
    assert STEP * high[0] + high[1] == MAX_DN
