import pytest
import torch
from torch.nn.functional import conv2d, pad

from beers_deploy.model.bank import bank_of_vector
from beers_deploy.model.convbeers import ConvBEERS, for_sensor, in_steps
from beers_deploy.model.variants import VARIANTS, Variant
from tests.model.networks import behind_a_bank, condition_of, plain


@pytest.mark.parametrize(
    ("name", "parameters"), [("convbeers", 1_219_841), ("convbeers-s", 157_825)]
)
def test_the_parameters_are_those_of_the_paper(name: str, parameters: int) -> None:
    assert sum(p.numel() for p in ConvBEERS(VARIANTS[name]).parameters()) == parameters


@pytest.mark.parametrize("name", VARIANTS)
def test_a_new_network_is_nearly_the_identity(name: str) -> None:
    scale = VARIANTS[name].scale
    image = torch.rand(1, 1, 37 * scale, 53 * scale, generator=torch.Generator().manual_seed(1))
    difference = (plain(VARIANTS[name])(image) - image).detach()
    assert bool(torch.isfinite(difference).all())
    assert float(difference.std()) < 0.1


def test_at_half_resolution_a_shift_by_a_place_shifts_the_result_and_a_pixel_does_not() -> None:
    """The four pixels of a place are separate channels, so tiles must be aligned to 2 pixels."""
    network = plain(Variant(1, 4, 2))
    side = 32
    image = torch.rand(1, 1, side, side, generator=torch.Generator().manual_seed(1))
    inner = slice(12, -12)
    output = network(image)
    deviations = [
        float(
            (network(image.roll(step, -1)).roll(-step, -1) - output)[..., inner, inner]
            .detach()
            .abs()
            .max()
        )
        for step in (2, 1)
    ]
    assert deviations[0] < 1e-6
    assert deviations[1] > 1e-4


VECTORS = torch.tensor([[-0.9, -0.8, 0.3, 0.2], [0.5, 0.1, -0.7, -0.6], [0.0, 0.9, 0.8, 0.9]])


def test_each_image_of_a_batch_uses_its_own_sensor() -> None:
    network = behind_a_bank(Variant(2, 5), 0.3)
    images = torch.rand(3, 1, 13, 17, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        together = network(images, condition_of(VECTORS))
        for number in range(3):
            alone, other = (
                for_sensor(network, VECTORS[k])(images[number : number + 1])[0]
                for k in (number, number - 1)
            )
            assert float((together[number] - alone).abs().max()) <= 1e-6
            assert float((together[number] - other).abs().max()) > 1e-3


@pytest.mark.parametrize("scale", [1, 2])
def test_a_body_that_adds_nothing_leaves_the_analytic_restoration(scale: int) -> None:
    network = behind_a_bank(Variant(2, 5, scale), 0.3)
    image = 0.4 + 0.002 * torch.rand(1, 1, 26, 22, generator=torch.Generator().manual_seed(0))
    torch.nn.init.zeros_(network.tail.weight)
    kernel = torch.from_numpy(bank_of_vector(tuple(VECTORS[1].tolist())).analytic).float()[
        None, None
    ]
    expected = image + conv2d(pad(image, [3] * 4, mode="reflect"), kernel)
    with torch.inference_mode():
        torch.testing.assert_close(
            network(image, condition_of(VECTORS[1:2])), expected, rtol=0, atol=1e-6
        )


def test_a_rounded_map_is_in_int8_steps_and_its_gradient_passes_only_where_it_is_not_clipped() -> (
    None
):
    maps = 8 * torch.randn(2, 3, 5, 7, generator=torch.Generator().manual_seed(1))
    maps.requires_grad_()
    step = torch.tensor([0.03125, 0.1, 0.7]).view(3, 1, 1).expand(2, 3, 1, 1)

    rounded = in_steps(maps, step)
    rounded.sum().backward()  # type: ignore[no-untyped-call]

    levels = (rounded / step).detach()
    torch.testing.assert_close(levels, levels.round(), rtol=0, atol=1e-5)
    torch.testing.assert_close(levels, (maps / step).detach().round().clamp(-128, 127))
    unclipped = (maps / step >= -128) & (maps / step <= 127)
    assert 0 < int(unclipped.sum()) < unclipped.numel()
    torch.testing.assert_close(maps.grad, unclipped.float())
