"""Tests of the training data of the example networks, and of the files that `--samples` reads."""

from pathlib import Path

import pytest
import tifffile
import torch

from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.quant.samples.own import read_samples
from examples.networks import NETWORKS, build
from examples.samples import batches, main
from examples.train_network import criterion


# There is one network for each kind of batch. The other networks read what the first one reads.
@pytest.mark.parametrize("name", ["dncnn", "espcn", "edsr4", "segment"])
def test_batches_fit_the_network_and_repeat_with_the_seed(name: str, scenes: list[Scene]) -> None:
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


@pytest.mark.parametrize("name", ["espcn", "segment"])
def test_a_file_of_samples_can_be_read(
    name: str, scenes: list[Scene], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "samples.npz"
    tifffile.imwrite(tmp_path / "drawn.tif", scenes[0].radiance)
    words = [name, "--count", "5", "--images", str(tmp_path), "--out", str(out)]
    assert main(words) == 0
    assert "wrote" in capsys.readouterr().out
    pairs = list(read_samples(out, NETWORKS[name].inputs, None).all.pairs)
    assert len(pairs) == 5
    assert (pairs[0][1].size > 0) == NETWORKS[name].restores
