import re
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.dpu.board import load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.graph import Network, Operation
from deploy.dpu.zoo.builder import Builder, Written
from deploy.dpu.zoo.networks import NETWORKS, network, published_rates, read_bytes, written
from deploy.dpu.zoo.notation import read_library
from profiles.errors import ModelError

RATES = published_rates()
HEADER = "network n\n family f\n host copy\n gop 1\n source here\n image {image}\n"


@pytest.mark.parametrize("name", NETWORKS)
def test_operations_are_the_published_ones(name: str) -> None:
    """A network written down wrongly would hardly have the published number of operations."""
    assert sum(op.operations for op in network(name).operations) == pytest.approx(NETWORKS[name].operations, rel=0.05)


# Parameters without biases and batch norms, from the papers or their repositories.
WEIGHTS = {
    "resnet-18": 11.68e6,
    "resnet-50 v1.5": 25.50e6,
    "vgg-16": 138.34e6,
    "squeezenet 1.1": 1.23e6,
    "mobilenet v1": 4.21e6,
    "inception v3": 23.80e6,
    "yolo v3 coco": 61.90e6,
    "yolo v5 n": 1.86e6,
    "yolox m": 25.3e6,
    "efficientnet edgetpu s": 5.39e6,
}


@pytest.mark.parametrize(("name", "weights"), WEIGHTS.items())
def test_weights_are_the_published_ones(name: str, weights: float) -> None:
    assert sum(op.weight_bytes for op in network(name).operations) == pytest.approx(weights, rel=0.01)


def test_every_network_has_a_rate_and_every_rate_a_network() -> None:
    assert {rate.network for rate in RATES} == set(NETWORKS)
    assert len(NETWORKS) >= 60
    assert {rate.board for rate in RATES} == {"vck190", "zcu102", "zcu104", "kv260", "vek280"}
    assert len(set(RATES)) == len(RATES)


def test_every_rate_names_its_line_and_its_model() -> None:
    line = r"(\S+\.md:\d+|\S+\.(xlsx|csv) (row|record) \d+|issue \d+): [a-z0-9]+_\S+"
    assert [rate for rate in RATES if not re.fullmatch(line, rate.source)] == []


def test_several_threads_are_no_slower_than_one() -> None:
    assert all(0 < (rate.fps_single or rate.fps) <= rate.fps for rate in RATES)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_operation_reads_what_is_there(name: str) -> None:
    assert_sound(network(name))


def assert_sound(net: Network) -> None:
    """Each operation reads results made before it, in the shapes that they have."""
    made = dict(net.inputs)
    for op in net.operations:
        assert tuple(made[tensor] for tensor in op.inputs) == op.in_shapes
        assert op.out_shape is not None
        assert min(op.out_shape) > 0
        made[op.output] = op.out_shape
        if op.kind == "add":
            assert len(set(op.in_shapes)) == 1
    assert set(net.outputs) <= set(made)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_result_is_read(name: str) -> None:
    """Nothing is computed in vain: a kept result that no line reads would be a slip."""
    net = network(name)
    read = {tensor for op in net.operations for tensor in op.inputs} | set(net.outputs)
    assert [op.name for op in net.operations if op.output not in read] == []


@pytest.mark.parametrize("name", [name for name in NETWORKS if name.startswith(("yolo", "tiny"))])
def test_a_yolo_host_reads_one_score_a_box(name: str) -> None:
    """yolov3.cpp and yolovx.cpp of AMD's library; YOLOv6 has no such score, its classes are read instead."""
    net, boxes = network(name), {"yolo v2": 5, "yolox m": 1, "yolox nano": 1}.get(name, 3)
    maps = [op for op in net.operations if op.output in net.outputs]
    cells = sum(op.out_bytes // op.channels[1] for op in maps)
    expected = 80 * cells // 2 if name == "yolo v6 m" else boxes * cells
    assert read_bytes(name) == expected


@pytest.mark.parametrize("name", NETWORKS)
def test_the_host_reads_no_more_than_there_is(name: str) -> None:
    sizes = {op.output: op.out_bytes for op in network(name).operations}
    assert 0 < read_bytes(name) <= sum(sizes[output] for output in network(name).outputs)


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_of_the_zoo_pass_the_rules(name: str) -> None:
    """AMD compiled them for these boards: a rule that refuses them is wrong."""
    for board in dict.fromkeys(["vck190", *(rate.board for rate in published_rates() if rate.network == name)]):
        failed = place(network(name), load_dpu(board)).failed
        assert [(node.op.name, node.broken) for node in failed] == []


def written_down(folder: Path, steps: str, blocks: str = "", image: str = "8 8") -> Written:
    """A network of these lines."""
    indented = "".join(f" {line}\n" for line in steps.splitlines())
    (folder / "made.net").write_text(blocks + HEADER.format(image=image) + indented, encoding="utf-8")
    return read_library([folder / "made.net"]).write("n")


def last(folder: Path, steps: str, blocks: str = "", image: str = "8 8") -> Operation:
    """The last operation of a network of these lines."""
    return written_down(folder, steps, blocks, image).network.operations[-1]


# What a step makes of 8 channels of 8 x 8, and the weights that it has.
STEPS = {
    "conv 5": ((5, 8, 8), 9 * 8 * 5),
    "conv 5 1x7 2": ((5, 4, 4), 7 * 8 * 5),
    "conv 5 5 1 valid": ((5, 4, 4), 25 * 8 * 5),
    "conv 4 3 1 g=4": ((4, 8, 8), 9 * 2 * 4),
    "conv ch/2-1 1": ((3, 8, 8), 8 * 3),
    "dw 3 2": ((8, 4, 4), 9 * 8),
    "dw 3 m=2": ((16, 8, 8), 9 * 16),
    "transposed 3 4 2": ((3, 16, 16), 16 * 8 * 3),
    "fc 10": ((10, 1, 1), 64 * 8 * 10),
    "pool 3 2": ((8, 4, 4), 0),
    "pool 3 2 valid": ((8, 3, 3), 0),
    "mean 2 2": ((8, 4, 4), 0),
    "global": ((8, 1, 1), 0),
    "scale": ((8, 8, 8), 8),
    "pool 3 2 ceil": ((8, 4, 4), 0),
    "pool 3 3 ceil": ((8, 3, 3), 0),
    "resize": ((8, 16, 16), 0),
    "bilinear 4": ((8, 32, 32), 0),
    "shuffle": ((2, 16, 16), 0),
    "unshuffle 4": ((128, 2, 2), 0),
    "add x": ((8, 8, 8), 0),
    "concat x x": ((24, 8, 8), 0),
    "s = global\nmul s": ((8, 8, 8), 0),
    "slice 2 3": ((3, 8, 8), 0),
    "hsigmoid": ((8, 8, 8), 0),
    "y = pool 2 2\npool 3 3 | resize y": ((8, 4, 4), 0),
}


@pytest.mark.parametrize(("step", "expected"), STEPS.items(), ids=STEPS)
def test_each_step_makes_the_shape_it_promises(tmp_path: Path, step: str, expected: object) -> None:
    op = last(tmp_path, f"conv 8 1\n{step}")
    assert (op.out_shape, op.weight_bytes) == expected


def test_kept_results_and_blocks(tmp_path: Path) -> None:
    blocks = "block twice c k=1 # comment\n  conv c k *2\nblock join other\n concat other\n"
    made = written_down(tmp_path, "y = twice 4 | out\nz = y | conv ch 3\njoin y | twice 6 3\nz", blocks)
    shapes = [op.out_shape for op in made.network.operations]
    assert shapes == [(4, 8, 8), (4, 8, 8), (3, 8, 8), (7, 8, 8), (6, 8, 8), (6, 8, 8)]
    assert made.network.outputs == (made.network.operations[1].output,)


def test_the_host_reads_the_channels_that_are_stated(tmp_path: Path) -> None:
    made = written_down(tmp_path, "y = conv 10 | out 2\nconv 4 | out")
    assert list(made.read_bytes.values()) == [2 * 64, 4 * 64]
    assert list(written_down(tmp_path, "conv 10").read_bytes.values()) == [10 * 64]


# What a line of the file must not say, and a part of the answer.
WRONG = {
    "convolve 5": "a step, a block or a kept result",
    "conv": "conv with channels",
    "conv 5 3 1 4": "conv with channels",
    "conv 5 q=2": "conv with channels",
    "conv c": "a whole number",
    "conv 5/2": "a whole number",
    "conv 5/0": "a whole number",
    "conv -1": "a whole number",
    "conv 0": "numbers of 1 and more",
    "conv 5 3 0": "numbers of 1 and more",
    "conv 5 0x3": "numbers of 1 and more",
    "shuffle 0": "numbers of 1 and more",
    "conv 9**9": "a whole number",
    "conv 5 g=2": "equal groups",
    "conv 5 99 1 valid": "a result of one pixel or more",
    "conv 5 | ": "a step between bars",
    "concat": "concat with",
    "concat 5": "concat with",
    "conv x": "conv with channels",
    "resize x x": "resize with",
    "conv 5 3 1 ceil": "conv with channels",
    "y = conv 4\nadd y": "shapes that agree",
    "y = conv 4 3 2\nconcat y": "shapes that agree",
    "shuffle": "a multiple of 4 channels",
    "slice 2 2": "channels below 3",
    "out 4": "at most 3 channels",
    "round": "blocks within one another",
    "needs": "needs c",
    "needs 1 2": "needs c",
}


@pytest.mark.parametrize(("steps", "answer"), WRONG.items(), ids=WRONG)
def test_an_error_names_file_and_line(tmp_path: Path, steps: str, answer: str) -> None:
    blocks = "block round\n round\nblock needs c\n conv c\n"
    with pytest.raises(ModelError, match=re.escape(answer)) as caught:
        written_down(tmp_path, steps, blocks)
    line = 2 if steps == "round" else 10 + len(steps.splitlines())
    assert str(caught.value).startswith(f"made.net, line {line}: ")


# What a file must not look like.
UNREADABLE = {
    "  conv 5\n": "block or network before",
    "layers x\n": "block NAME PARAMETER",
    "network \n": "block NAME PARAMETER",
    "block conv c\n": "a new name",
    "block a\nblock a\n": "a new name",
    "network n\n family f\n": "no host",
    HEADER.format(image="8 8").replace("copy", "paint"): "host one of",
    HEADER.format(image="8 8").replace("gop 1", "gop much"): "gop and a number",
    HEADER.format(image="8"): "image HEIGHT WIDTH",
    HEADER.format(image="8 0"): "image HEIGHT WIDTH",
}


@pytest.mark.parametrize(("text", "answer"), UNREADABLE.items(), ids=UNREADABLE)
def test_a_file_that_is_no_library(tmp_path: Path, text: str, answer: str) -> None:
    (tmp_path / "made.net").write_text(text, encoding="utf-8")
    with pytest.raises(ModelError, match=re.escape(answer)) as caught:
        read_library([tmp_path / "made.net"]).write("n")
    assert str(caught.value).startswith("made.net, line ")


SIZES = st.integers(1, 6)


@given(
    image=st.tuples(st.integers(8, 40), st.integers(8, 40)),
    convs=st.lists(st.tuples(st.integers(1, 9), SIZES, st.integers(1, 3)), min_size=1, max_size=5),
)
def test_a_chain_has_the_operations_of_its_formula(
    tmp_path_factory: pytest.TempPathFactory, image: tuple[int, int], convs: list[tuple[int, int, int]]
) -> None:
    """2 kernel^2 channels in, out, and pixels of ceil(size / stride), layer by layer."""
    steps = " | ".join(f"conv {channels} {kernel} {stride}" for channels, kernel, stride in convs)
    net = written_down(tmp_path_factory.getbasetemp(), steps, image=f"{image[0]} {image[1]}").network
    before, (height, width) = 3, image
    for op, (channels, kernel, stride) in zip(net.operations, convs, strict=True):
        height, width = -(-height // stride), -(-width // stride)
        assert op.out_shape == (channels, height, width)
        assert op.operations == 2 * kernel**2 * before * channels * height * width
        before = channels
    assert_sound(net)


@pytest.mark.parametrize("side", [224, 225, 17])
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_shapes_follow_the_two_paddings(side: int, stride: int) -> None:
    b = Builder(side, side + 2)
    same, valid = (b.conv(b.image, 5, 3, stride, valid=valid) for valid in (0, 1))
    assert same.shape == (5, -(-side // stride), -(-(side + 2) // stride))
    assert valid.shape == (5, (side - 3) // stride + 1, (side - 1) // stride + 1)


def test_steps_keep_their_order() -> None:
    net = network("vgg-16")
    assert all(later.inputs == before.outputs for before, later in pairwise(net.operations))
    assert written("vgg-16") is written("vgg-16")
