"""Patches: the fast distance against its definition, and overlap-add against the counting of patches."""

import numpy as np
import torch

from beers_deploy.model.traditional.nl_bayes import overlap_add, patch_matrix, window_distances, window_numbers


def image(height: int, width: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(4).normal(5000, 12, (height, width)).astype(np.float32))


def test_distances_are_the_sums_of_squared_differences() -> None:
    guide, side, window = image(23, 28), 5, 7
    rows, columns = torch.tensor([0, 3, 6, 12]), torch.tensor([0, 4, 8, 12, 17])
    distances = window_distances(guide, rows, columns, side, window)
    first, steps = window_numbers(rows, columns, 28 - side + 1, window)
    patches = patch_matrix(guide, side)
    middle = steps[window**2 // 2]
    expected = (patches[first + steps] - patches[first + middle]).square().sum(2)
    expected[:, window**2 // 2] = -1
    torch.testing.assert_close(distances, expected, rtol=1e-5, atol=1e-2)


def test_overlap_add_is_the_adjoint_of_cutting_patches() -> None:
    one = image(13, 17).double()
    other = torch.from_numpy(np.random.default_rng(5).standard_normal((9 * 13, 25)))
    cut = (patch_matrix(one, 5) * other).sum()
    pasted = (one * overlap_add(other, one.shape, 5)).sum()
    torch.testing.assert_close(cut, pasted)


def test_a_middle_pixel_lies_in_all_the_patches_around_it() -> None:
    count = overlap_add(torch.ones(9 * 13, 25), torch.Size((13, 17)), 5)
    assert float(count[6, 8]) == 25
    assert float(count[0, 0]) == 1
