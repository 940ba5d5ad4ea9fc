"""Networks for the fuzzer to damage, as ONNX and as weights, and the functions that read them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import torch

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import read_sized_graph
from beers_deploy.model.convbeers import BankedConvBEERS, ConvBEERS, save_network
from beers_deploy.model.training.checkpoint import TrainingRecipe
from beers_deploy.model.training.source import Batch
from beers_deploy.model.training.trainer import Trainer
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import BeersError
from beers_deploy.quant.encodings import encoding_faults
from beers_deploy.quant.graph import correction_graph
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_any_size, open_session, run
from beers_deploy.quant.structure import count_relus, rounded_tensors, saturated_shares
from beers_deploy.quant.tiling.receptive_field import tiling_of
from tests.deploy.dpu.graphs import board_convbeers, float_convbeers, integer_convbeers
from tests.fuzz.pictures import written
from tests.quant.quick import fix_sizes
from tests.quant.simplify.networks import CASES, network_from

SIDE_PX = 16
RECIPE = TrainingRecipe(steps=10)
SMALL = Variant(1, 2)


def onnx_seeds(folder: Path) -> list[bytes]:
    """Return the three encodings of a small network, and its float file fixed to a tile."""
    encodings = (float_convbeers, integer_convbeers, board_convbeers)
    paths = [
        written(partial(encoding, blocks=1, features=2), folder / "a.onnx")
        for encoding in encodings
    ]
    fixed = onnx.load_model(float_convbeers(folder / "a.onnx", 1, 2))
    for value in (*fixed.graph.input, *fixed.graph.output):
        fix_sizes(value, 1, 1, SIDE_PX, SIDE_PX)
    return [*paths, fixed.SerializeToString()]


def exported_seeds(_: Path) -> list[bytes]:
    """Return networks like those of exporters: computed constants, normalisation, padding, other
    opsets, 16-bit floats.
    """
    sizes = CASES["sizes computed from constants"][0]
    scaled = CASES["normalised and scaled again"][0]
    idle = CASES["operators without an effect"][0]
    networks = [
        network_from(sizes),
        network_from(scaled, 9),
        network_from(sizes, 20),
        network_from(idle, kind="float16"),
    ]
    return [network.SerializeToString() for network in networks]


def check_onnx(path: Path) -> None:
    """Read a network and place it on a board, as `check` does."""
    place(read_sized_graph(path, SIDE_PX), load_dpu("vck190"))


def analyse_onnx(path: Path) -> None:
    """Analyse a network as `quantize`, `restore` and `gate` do before they run it."""
    model = load_onnx(path)
    analyses = (
        fixed_tile_px,
        tiling_of,
        correction_graph,
        count_relus,
        encoding_faults,
        rounded_tensors,
    )
    for analyse in analyses:
        _run_analysis(analyse, model)


def _run_analysis(analyse: Callable[[onnx.ModelProto], object], model: onnx.ModelProto) -> None:
    try:
        analyse(model)
    except BeersError as error:
        if not str(error).isprintable():
            raise ValueError("no sentence") from error


def run_onnx(path: Path) -> None:
    """Run the file as `gate` does, whether it is fixed to a tile or not."""
    model = load_onnx(path)
    image = np.full((1, 1, SIDE_PX, SIDE_PX), 0.25, np.float32)
    run(open_session(model, 1), image)
    run(open_any_size(model), image[:, :, :9])
    saturated_shares(model, [image])


def checkpoint_seeds(folder: Path) -> list[bytes]:
    return [
        written(partial(_checkpoint, steps=steps), folder / "c.safetensors") for steps in (0, 1)
    ]


def _checkpoint(path: Path, steps: int) -> None:
    trainer = Trainer(SMALL, RECIPE)
    for _ in range(steps):
        _step(trainer)
    trainer.save(path)


def _step(trainer: Trainer) -> None:
    trainer.train_step(Batch(torch.ones(1, 1, 5, 5), torch.zeros(1, 1, 5, 5)))


def go_on(path: Path) -> None:
    trainer = Trainer(SMALL, RECIPE)
    trainer.resume(path)
    _step(trainer)


def weights_seeds(folder: Path, kind: type[BankedConvBEERS | ConvBEERS] = ConvBEERS) -> list[bytes]:
    """Return the weights of a network. A banked network is conditioned on a sensor."""
    save = partial(save_network, network=kind(SMALL), recipe={"degraded": "x"})
    return [written(save, folder / "w.safetensors")]
