"""A network in training mode is refused; the same nodes in inference mode are folded."""

from pathlib import Path

import pytest

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx
from tests.quant.simplify.networks import CONV, network_from

DROPOUT = "d = Dropout(c, half, mode)"
NORMAL = "BatchNormalization{}(c, gain, offset, mean, variance)"
ON = "mode = Constant<value = bool {1}>()"
OFF = "mode = Constant<value = bool {0}>()"
COMPUTED = "on = Constant<value = bool {1}>() mode = Identity(on)"
TRAINING = {
    "dropout": (f"{ON} {DROPOUT}", 17),
    "dropout of a mode that is computed": (f"{COMPUTED} {DROPOUT}", 17),
    "normalisation": (f"d, m, v = {NORMAL.format('<training_mode=1>')}", 17),
    "normalisation by its outputs": (f"d, m, v, sm, sv = {NORMAL.format('')}", 9),
    "stochastic depth": ("r = RandomUniformLike<dtype=1>(half) d = Mul(c, r)", 17),
    "old dropout": ("d = Dropout(c)", 6),
}
INFERENCE = {
    "dropout": (f"{OFF} {DROPOUT}", 17),
    "dropout without a mode": ("d = Dropout(c)", 17),
    "normalisation": (f"d = {NORMAL.format('<training_mode=0>')}", 17),
    "normalisation before modes": (f"d = {NORMAL.format('')}", 9),
}


def saved(nodes: str, opset: int, folder: Path) -> Path:
    """Write a network with nodes between a convolution and a ReLU."""
    path = folder / "network.onnx"
    path.write_bytes(network_from(f"{CONV} {nodes} y = Relu(d)", opset).SerializeToString())
    return path


@pytest.mark.parametrize("name", TRAINING)
def test_training_mode_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    path = saved(*TRAINING[name], tmp_path)
    with pytest.raises(ModelError, match=r"in training mode.*model\.eval") as caught:
        load_onnx(path)
    assert str(caught.value).isprintable()
    load_onnx(path, to_run=False)


@pytest.mark.parametrize("name", INFERENCE)
def test_the_same_nodes_in_inference_mode_are_folded(name: str, tmp_path: Path) -> None:
    path = saved(*INFERENCE[name], tmp_path)
    assert [node.op_type for node in load_onnx(path).graph.node] == ["Conv", "Relu"]
