"""Test that every option of every verb is described, and refused where it has no effect."""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from inspect import Parameter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import beers_deploy as bd
from beers_deploy.cli.commands import COMMANDS, app
from beers_deploy.profiles.errors import BeersError, ImageError, OptionError
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.verbs.restore import restore
from tests.deploy.verb_parameters import existing, options


@dataclass(frozen=True)
class Refused:
    """Options that one command refuses together.

    Attributes:
        options: the parameters, each of which is refused.
        beside: other words on the command line; words in capitals are files.
        without: the option without which they are refused.
    """

    options: tuple[str, ...]
    beside: str = ""
    without: str = ""


SCHEDULER = "--scheduler tcp://host:8786"
INT8 = "--network convbeers-xs-int8"
REFUSED = {
    "demo": [Refused(("full_scale",), without="--image")],
    "profiles": [Refused(("toml",), without="NAME")],
    "simulate": [
        Refused(("workers",), f"--out data {SCHEDULER}"),
        Refused(("explain",), "--out data"),
        Refused(("workers", "scheduler", "resume"), "--explain", without="--out"),
    ],
    "train": [
        Refused(
            ("sensor", "variant", "steps", "seed", "validate_every", "pairs", "conditioned"),
            "--recipe convbeers-xs --images aerial/",
        ),
        Refused(("images", "drawn", "conditioned"), "--pairs PAIRS"),
        Refused(("validate_every",), without="--images"),
        Refused(("lpips",), "--lpips-weight 0"),
        Refused(("rounding",), without="--conditioned"),
    ],
    "export": [
        Refused(("board_file", "c", "delta", "apply"), without="--network"),
        Refused(("target",), without="--board-file"),
        Refused(("sensor", "delta"), f"{INT8} --apply APPLY"),
    ],
    "quantize": [
        Refused(("tile",), without="--board-file"),
        Refused(("images", "patches", "patch", "seed"), "--samples SAMPLES"),
    ],
    "gate": [Refused(("images", "patches", "seed"), "--samples SAMPLES")],
    "golden": [Refused(("out", "tile", "target"), "--compare COMPARE")],
    "bench": [
        Refused(
            (
                "image",
                "full_scale",
                "size",
                "halo",
                "dpu",
                "host_task",
                "measured",
                "traditional",
                "within",
                "consistency",
            ),
            "--target host",
        ),
        Refused(("threads",), without="--target"),
        Refused(("full_scale",), without="--image"),
        Refused(("size",), "--image IMAGE"),
    ],
    "restore": [
        Refused(
            (
                "network",
                "tile",
                "halo",
                "runtime",
                "threads",
                "scheduler",
                "resume",
                "dry_run",
                "consistency",
                "exposure",
                "interval",
            ),
            "--method traditional",
        ),
        Refused(("quality",), without="--method"),
        Refused(("stac",), without="--cog"),
        Refused(("compression", "cog", "view", "resume", "overwrite"), "--dry-run", without="OUT"),
    ],
    "evaluate": [
        Refused(("images", "sweep", "brightness"), "--pairs PAIRS"),
        Refused(("labels", "split", "side", "classes"), without="--detector"),
        Refused(("strict",), without="--pairs"),
        Refused(
            ("pairs", "calibrate", "sweep", "strict", "exposure", "bits_per_pixel"),
            "--detector DETECTOR",
        ),
    ],
    "tradeoff": [Refused(("out",), "--dry-run")],
    "stress": [
        Refused(("cases", "stages"), "--bit-flips"),
        Refused(("draws", "images", "target"), without="--bit-flips"),
    ],
}


def refused_options() -> Iterator[tuple[str, str, Refused]]:
    """Yield a command, one of its options, and a combination in which the option is refused."""
    for name, cases in REFUSED.items():
        for case in cases:
            for option in case.options:
                yield name, option, case


@pytest.mark.parametrize("name", COMMANDS)
def test_every_parameter_is_described_once_and_in_order(name: str) -> None:
    """The docstring is the only text about an option: help and reference are built from it."""
    command = COMMANDS[name]
    described = [entry.arg_name for entry in command.doc.params]
    own = list(options(name))
    assert [word for word in described if word in own] == own
    assert all((entry.description or "").rstrip().endswith(".") for entry in command.doc.params)
    assert command.doc.returns is not None
    assert len(command.doc.short_description or "") <= 100
    assert (command.doc.short_description or "").endswith(".")


@pytest.mark.parametrize(("name", "option", "case"), list(refused_options()), ids=str)
def test_a_combination_is_refused(
    name: str, option: str, case: Refused, working_folder: Path
) -> None:
    by_name = options(name)
    beside = [existing(word) if word.isupper() else word for word in case.beside.split()]
    needed: list[str] = []
    for parameter in by_name.values():
        if parameter.required and parameter.name != option and parameter.label not in beside:
            needed += parameter.switched()
    command = [name, *needed, *beside, *by_name[option].switched()]
    before = sorted(working_folder.rglob("*"))
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2, (command, result.output)
    sentence = result.stderr.removeprefix("beers-deploy: ")
    assert by_name[option].label in sentence, (command, sentence)
    others = [*case.without.split(), *(word for word in beside if word.startswith("--"))]
    assert any(word in sentence for word in others), (command, sentence)
    assert result.stderr.count("\n") == 1, result.stderr
    assert sorted(working_folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"full_scale": "4095"}, "`full_scale` must be one number, got '4095'"),
        ({"nodata": "x"}, "`nodata` must be one number, got 'x'"),
        ({"full_scale": [4095]}, "`full_scale` must be one number"),
        ({"full_scale": 10**400}, "`full_scale` must be one number"),
        ({"full_scale": 1e300}, "`full_scale` must be an integer of 1 to 65535"),
        ({"threads": 1.5}, "`threads` must be an integer, got 1.5"),
        ({"tile": True}, "`tile` must be one number, got True"),
        ({"strict": "no"}, "`strict` must be True or False, got 'no'"),
        ({"tile": np.int64(7)}, "`tile` must be a finite number of at least 16, got 7"),
        ({"full_scale": np.zeros(1)}, "`full_scale` must be one number"),
        ({"compression": None}, "`compression` must be one of"),
        ({"sensor": 5}, "A sensor must be a Sensor, a name or the path"),
    ],
    ids=str,
)
def test_a_value_of_another_type_is_refused_in_one_sentence(
    value: dict[str, object], words: str
) -> None:
    with pytest.raises(BeersError, match=re.escape(words)):
        restore(np.full((20, 30), 900, np.uint16), network="convbeers-xs", **value)  # type: ignore[arg-type]


WRONG_TYPES = [5, 2.5, {"a": 1}, [5], [None], ((1, 2),), np.zeros((2, 2)), object()]
"""Values that are neither a text nor a path, nor a list of them."""


@pytest.mark.parametrize("value", WRONG_TYPES, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_text_or_path_of_another_type_is_refused(name: str, value: object) -> None:
    names = ("lpips", "recipe", "scene", "with_", "edge", "cases", "need", "scheduler", "out")
    asked = [option for option in names if option in options(name)]
    for option in asked:
        function = COMMANDS[name].verb
        required = {
            other.name: "a.tif"
            for other in options(name).values()
            if other.parameter.default is Parameter.empty
        }
        with pytest.raises(OptionError, match=f"`{option}` must be a (path|text)"):
            function(**{**required, option: value})


@pytest.mark.parametrize("value", [None, 3], ids=str)
def test_what_is_no_path_of_an_output_is_refused(value: Any) -> None:
    network = bd.Network.load("convbeers-xs-int8")
    sensor = bd.Sensor.load("pleiades-degraded")
    kit = partial(bd.Board.load("zcu104").kit, network)
    for write in (network.save, sensor.save, bd.boards().save, kit):
        with pytest.raises(OptionError, match=f"must be a path, got {value}"):
            write(value)


@pytest.mark.parametrize("value", [None, "raw.tif", Path("raw.tif")], ids=repr)
def test_a_path_in_the_place_of_pixels_is_refused(value: Any) -> None:
    network = bd.Network.load("convbeers-xs-int8")
    sensor = bd.Sensor.load("pleiades-degraded")
    for compute in (network, sensor.to_dn, sensor.to_radiance, sensor.noise):
        with pytest.raises(ImageError, match="must be numbers or an array, got"):
            compute(value)


def test_the_side_of_a_core_may_be_an_integer_of_numpy_and_no_text() -> None:
    network = bd.Network.load("convbeers-xs-int8")
    side: Any = np.int64(64)
    assert fixed_tile_px(network.core(tile=side).model) == 70
    for side in ("64", 0, -64, 64.0):
        with pytest.raises(OptionError, match="`tile` must be a multiple of 1 px"):
            network.core(tile=side)


def test_an_empty_list_of_boards_is_refused() -> None:
    with pytest.raises(OptionError, match="`target` names no board"):
        bd.bench("convbeers-xs", target=[], traditional=False)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_a_number_beyond_the_pixels_or_the_machine_limits_nothing(kind: type) -> None:
    image: np.ndarray = np.full((20, 30), 900, kind)
    expected = restore(image, network="convbeers-xs")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = restore(image, network="convbeers-xs", nodata=1e300, memory=1e300)
    np.testing.assert_array_equal(result, expected)
