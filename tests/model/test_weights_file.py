import errno
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from beers_deploy.model.convbeers import (
    BankedConvBEERS,
    TrainableNetwork,
    arrays,
    load_network,
    save_network,
)
from beers_deploy.model.io.tensors import (
    is_conditioned,
    read_conditioned,
    read_plain,
    read_tensors,
    write_tensors,
)
from beers_deploy.model.metrics import perceptual
from beers_deploy.model.shipped import SHIPPED, shipped_names, shipped_weights
from beers_deploy.model.training.recipe import load_recipe
from beers_deploy.model.variants import VARIANTS, Variant, variant_named
from beers_deploy.profiles.errors import MachineError, ModelError, OptionError
from tests.model.networks import behind_a_bank, plain


def conditioned() -> BankedConvBEERS:
    return behind_a_bank(Variant(1, 4), 0.1)


@pytest.mark.parametrize(
    "network", [*(plain(Variant(*size)) for size in ((0, 1), (1, 4, 2), (3, 5))), conditioned()]
)
def test_a_saved_network_is_loaded_unchanged(network: TrainableNetwork, tmp_path: Path) -> None:
    path = tmp_path / "made" / "w.safetensors"
    save_network(path, network, {"loss": "L1", "steps": 7})
    loaded, recipe = load_network(path)
    assert type(loaded) is type(network)
    assert loaded.variant == network.variant
    assert recipe == {"loss": "L1", "steps": 7}
    assert not loaded.training
    assert all(
        torch.equal(value, loaded.state_dict()[name])
        for name, value in network.state_dict().items()
    )
    assert [p.name for p in path.parent.iterdir()] == ["w.safetensors"]


def test_without_a_scale_a_network_has_full_resolution(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    write_tensors(path, arrays(plain().state_dict()), {"variant": {"blocks": 1, "features": 4}})
    assert load_network(path)[0].variant.scale == 1


def refused(path: Path, words: str) -> None:
    with pytest.raises(ModelError, match=words) as caught:
        load_network(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "variant",
    [
        {"blocks": 1, "features": 5},
        {"blocks": 10**9, "features": 4},
        {"blocks": -3, "features": 4},
        {"blocks": 1},
        {"blocks": "many", "features": 4},
        {"blocks": 1, "features": 4, "scale": 2},
        {"blocks": 1, "features": 4, "scale": 0},
        {"blocks": 1, "features": 4, "scale": -1},
        "convbeers",
        None,
    ],
)
def test_a_header_that_does_not_fit_the_tensors_is_refused(variant: object, tmp_path: Path) -> None:
    write_tensors(tmp_path / "w.safetensors", arrays(plain().state_dict()), {"variant": variant})
    refused(tmp_path / "w.safetensors", r"weights of a ConvBEERS|number")


@pytest.mark.parametrize("kind", [np.float64, np.float16, np.int32])
def test_weights_of_another_type_are_refused(kind: type, tmp_path: Path) -> None:
    tensors = arrays(plain().state_dict())
    other: dict[str, np.ndarray] = {name: value.astype(kind) for name, value in tensors.items()}
    write_tensors(tmp_path / "w.safetensors", other, {"variant": {"blocks": 1, "features": 4}})
    refused(tmp_path / "w.safetensors", "not finite float32")


@pytest.mark.parametrize(
    "metadata", [None, {"format": "pt"}, {"variant": json.dumps({"blocks": 1})}]
)
def test_another_programs_weights_are_refused(
    metadata: dict[str, str] | None, tmp_path: Path
) -> None:
    save_file({"weight": torch.zeros(3)}, tmp_path / "w.safetensors", metadata=metadata)
    refused(tmp_path / "w.safetensors", r"w\.safetensors")


def test_a_missing_file_and_an_unknown_variant(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such file"):
        read_tensors(tmp_path / "none.safetensors")
    for name in VARIANTS:
        assert variant_named(name) == VARIANTS[name]
    with pytest.raises(OptionError, match="convbeers-s"):
        variant_named("convbeers-huge")
    with pytest.raises(ModelError, match=r"convbeers-s.*train"):
        shipped_weights("convbeers-huge")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ModelError, match="it is not a regular file"):
        read_tensors(tmp_path / "pipe")


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(MachineError, match="cannot be written"):
        save_network(tmp_path / "file" / "w.safetensors", plain(), {})


@pytest.mark.parametrize("name", shipped_names())
def test_the_shipped_weights_load_and_record_how_they_were_made(name: str) -> None:
    shipped = read_conditioned(shipped_weights(name))
    recipe = shipped.recipe
    assert shipped.variant == VARIANTS[load_recipe(name).variant]
    assert recipe["degraded"] == "drawn over the ranges"
    # Recipes simulate the reference without noise. The older command had a noise-free profile.
    cut = shipped.kernels == "cut"
    assert recipe["reference"] == ("noise-free" if cut else "pleiades-reference")
    images = recipe["images"]
    assert isinstance(images, list)
    assert len(images) >= 50
    assert f"# {name}\n" in (SHIPPED / f"{name}.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "reader", [lambda path: read_tensors(path)[0], lambda path: perceptual.read_tensors(path, "ab")]
)
def test_loaded_arrays_are_copies(
    reader: Callable[[Path], Mapping[str, np.ndarray]], tmp_path: Path
) -> None:
    """Windows cannot replace a mapped file, and writing to the file must not change the arrays."""
    path = tmp_path / "w.safetensors"
    tensors = {
        "a": np.arange(3, dtype=np.float32),
        "b": np.arange(20_000, dtype=np.float32).reshape(100, 200),
    }
    write_tensors(path, tensors, {})
    loaded = reader(path)
    # The file is overwritten in place. A memory map of it would change as well.
    with path.open("r+b") as file:
        file.write(bytes(path.stat().st_size))
    assert all(np.array_equal(np.asarray(loaded[name]), value) for name, value in tensors.items())
    write_tensors(path, tensors, {})


def test_others_can_read_what_is_written(tmp_path: Path) -> None:
    """A saved file has the permissions of any other new file, as the user's umask sets them."""
    (tmp_path / "plain").touch()
    save_network(tmp_path / "w.safetensors", plain(), {})
    assert (tmp_path / "w.safetensors").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_full_disk_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, _: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(MachineError, match="No space left on device"):
        write_tensors(tmp_path / "w.safetensors", {"a": np.zeros(3, np.float32)}, {})
    assert not list(tmp_path.iterdir())


def test_conditioned_and_plain_weights_are_not_taken_for_one_another(tmp_path: Path) -> None:
    save_network(tmp_path / "conditioned.safetensors", conditioned(), {})
    save_network(tmp_path / "plain.safetensors", plain(), {})
    assert is_conditioned(tmp_path / "conditioned.safetensors")
    assert not is_conditioned(tmp_path / "plain.safetensors")
    with pytest.raises(ModelError, match="is conditioned on a sensor"):
        read_plain(tmp_path / "conditioned.safetensors")
    with pytest.raises(ModelError, match="not conditioned on a sensor"):
        read_conditioned(tmp_path / "plain.safetensors")


@pytest.mark.parametrize(
    ("change", "lacking", "words"),
    [
        ({"ranges": {"mtf_across": [0.01, 0.2]}}, "", "ranges"),
        ({"variant": {"blocks": 1, "features": 5}}, "", "shape"),
        ({"variant": {"blocks": 10**9, "features": 4}}, "", "tensors"),
        ({"kind": "conditioned on its sensor"}, "", "another version"),
        ({}, "tail.bias", r"w\.safetensors"),
        ({}, "bias.weight", r"w\.safetensors"),
    ],
)
def test_conditioned_weights_need_their_header_and_every_tensor(
    change: dict[str, object], lacking: str, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "w.safetensors"
    save_network(path, conditioned(), {})
    tensors, header = read_tensors(path)
    tensors = {name: value for name, value in tensors.items() if name != lacking}
    write_tensors(path, tensors, header | change)
    refused(path, words)


def test_the_same_weights_are_the_same_bytes(tmp_path: Path) -> None:
    """The library shuffles the keys of a header: 8 keys are in order once in 40 000 times."""
    header = {f"key {k}": {"ä": k} for k in range(8)}
    tensors = {
        "turned": np.arange(6.0).reshape(2, 3).T,
        "whole": np.array([1, -2]),
        "one": np.array(3.5),
    }
    contents = set()
    for number in range(4):
        write_tensors(tmp_path / f"{number}", tensors, header)
        contents.add((tmp_path / f"{number}").read_bytes())
    assert len(contents) == 1
    loaded, loaded_header = read_tensors(tmp_path / "0")
    assert loaded_header == header
    assert all(np.array_equal(loaded[name], value) for name, value in tensors.items())
