"""What the example networks learn from: what each is for, the same for the same seed, as
`--samples` reads it.
"""

from pathlib import Path

import pytest
import torch

from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.quant.samples.own import read_samples
from examples.networks import NETWORKS, build
from examples.samples import GAINS, batches, bright, main
from examples.train_network import criterion


# There is one network for each kind of batch. The other networks read what the first one reads.
@pytest.mark.parametrize("name", ["dncnn", "espcn", "edsr4", "segment"])
def test_batches_fit_the_network_and_come_again_with_the_seed(
    name: str, scenes: list[Scene]
) -> None:
    (image, reference), (repeated, _), (other, _) = (
        next(batches(name, scenes, seed)) for seed in (0, 0, 1)
    )
    with torch.inference_mode():
        loss = criterion(name)(build(name, torch.Generator().manual_seed(0))(image), reference)
    assert loss.isfinite()
    assert image.shape[1] == NETWORKS[name].inputs
    assert 0 <= float(image.min()) < float(image.max()) <= 1
    assert torch.equal(image, repeated)
    assert not torch.equal(image, other)


def test_bands_show_one_ground_with_a_gain_and_a_noise_of_their_own(scenes: list[Scene]) -> None:
    (image, reference) = next(batches("edsr4", scenes, 0))
    levels = reference.mean((0, 2, 3))
    assert torch.allclose(levels / levels[0], torch.tensor(GAINS) / GAINS[0], rtol=0.01)
    noise = (image / torch.tensor(GAINS).view(1, -1, 1, 1)).transpose(0, 1).flatten(1)
    # The ground is the same in each band, so the difference leaves the noise.
    between = noise - noise.mean(0)
    assert float(between.std(1).min()) > 0
    # One noise in every band would cancel and leave only rounding.
    assert float(torch.corrcoef(between[2:])[0, 1]) < 0.5


def test_bright_is_what_is_bright_around_a_pixel_and_not_the_pixel_alone() -> None:
    image = torch.zeros(1, 1, 33, 33)
    image[..., 5, 5] = 1.0
    image[..., 16:, 16:] = 0.5
    classes = bright(image)
    assert not classes[0, 5, 5]
    assert classes[0, 20:, 20:].all()


@pytest.mark.parametrize("name", ["espcn", "segment"])
def test_a_file_of_samples_is_read_as_data(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "samples.npz"
    assert main([name, "--count", "5", "--out", str(out)]) == 0
    assert "wrote" in capsys.readouterr().out
    pairs = list(read_samples(out, NETWORKS[name].inputs, None).all.pairs)
    assert len(pairs) == 5
    assert (pairs[0][1].size > 0) == NETWORKS[name].restores


def test_other_names_and_counts_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["segment", "--out", str(tmp_path / "samples.npy")]) == 2
    assert "ends in .npz" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["segment", "--count", "0", "--out", str(tmp_path / "samples.npz")])
    assert not list(tmp_path.iterdir())
