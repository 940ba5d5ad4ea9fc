"""`stress`: hard cases and bit flips against a network."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    InputPath,
    Interval,
    Names,
    NetworkLike,
    NextTo,
    OutputFile,
    Progress,
    Seed,
    SensorLike,
    TargetLike,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.results import Table

DRAWS = 6
CURVES = ".svg"
"""Suffix of the curves, next to the tables."""


@verb
def stress(
    float_network: NetworkLike | None = None,
    int8_network: NetworkLike | None = None,
    *,
    cases: Names | None = None,
    stages: Names | None = None,
    side: Annotated[int, Interval(ge=16, le=4096)] = 96,
    bit_flips: bool = False,
    draws: Annotated[int, Interval(ge=1, le=10_000)] = DRAWS,
    sensor: SensorLike = SENSOR,
    images: InputPath | None = None,
    target: TargetLike = DEFAULT_TARGET,
    seed: Seed = 0,
    out: Annotated[OutputFile, NextTo(CURVES, when="bit_flips")] | None = None,
    progress: Progress = None,
) -> "Table":
    """Run hard cases through a network in float32, in INT8, in integers alone and in tiles.

    The tables show which checks hold, the worst measurements, known limitations that were met, and
    which sums are proven not to overflow. The command exits with 1 if something fails. `bit_flips`
    shows the loss by flipped bits in weights, shifts, feature maps and the image, and the gain and
    cost of guards on the board.

    Args:
        float_network: float ONNX or weights. The name of a shipped pair stands for both;
            convbeers-s by default.
        int8_network: its INT8 ONNX; that of the shipped pair by default.
        cases: only these cases, separated by commas, such as night,snow.
        stages: only these stages, separated by commas, such as float32,INT8.
        side: side of the images in pixels, if a case has none of its own.
        bit_flips: inject bit flips into the INT8 network instead of running hard cases.
        draws: number of injections into each memory at each rate.
        sensor: sensor of a shipped network, and of the patches for bit flips: name or .toml file.
        images: folder of aerial images for the patches for bit flips; drawn scenes by default.
        target: board whose cost model predicts the cost of the guards: name or .toml file.
        seed: seed of every random draw.
        out: tables as Markdown; with `bit_flips` the curves are written next to it as SVG.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of the cases. It is true if nothing failed.

    Raises:
        ModelError: a network that cannot be tiled, or a float and an INT8 network that are swapped.
        OptionError: no such case or stage, stages that check nothing of the cases, or options that
            do not go together.
    """
    options = partial(changed, stress, locals())
    if bit_flips:
        refuse_with("`bit_flips`", **options("cases", "stages"))
    else:
        refuse_without("`bit_flips`", **options("draws", "images", "target"))
    # These load torch.
    from beers_deploy.model.io.files import write_text
    from beers_deploy.studies.stress.battery import battery_table, chosen
    from beers_deploy.studies.stress.bit_flips import flip_curves_svg, flip_table
    from beers_deploy.studies.stress.cases import CASES
    from beers_deploy.studies.stress.networks import open_subject
    from beers_deploy.studies.stress.stages import STAGES

    names = chosen(cases, [case.name for case in CASES], "cases")
    stage_names = chosen(stages, STAGES, "stages")
    subject = open_subject(float_network, int8_network, sensor)
    if bit_flips:
        from beers_deploy.profiles.sensor import Sensor
        from beers_deploy.profiles.target import TargetProfile
        from beers_deploy.quant.samples.simulated import Calibration

        scenes = path_or_none(images)
        patches = Calibration(Sensor.load(sensor), scenes, draws, side, seed)
        table = flip_table(subject, patches, TargetProfile.load(target))
        if out is not None:
            svg = flip_curves_svg({subject.quantized.source.name: table.rows})
            write_text(Path(out).with_suffix(CURVES), svg)
    else:
        table = battery_table(
            subject, [case for case in CASES if case.name in names], stage_names, seed, side
        )
    if out is not None:
        write_text(Path(out), table.to_markdown())
    return table
