"""`beers-deploy stress`: hard cases and bit flips against a network.

Exit code 1 when something fails.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import (
    BOARDS,
    FloatModel,
    Int8Model,
    Json,
    Seed,
    arguments,
    refuse,
    save,
    say,
)
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.figures import Row, by_table
from beers_deploy.profiles.sensor_file import load_sensor
from beers_deploy.profiles.target import DEFAULT_TARGET

if TYPE_CHECKING:
    from beers_deploy.studies.stress.battery import StageResult


HARD_CASES_ONLY = ("cases", "stages")
BIT_FLIPS_ONLY = ("draws", "images", "target")


def stress(
    context: typer.Context,
    float_model: FloatModel = None,
    int8_model: Int8Model = None,
    cases: Annotated[
        str | None, typer.Option(help="Only these cases, with commas: 'night,snow'.")
    ] = None,
    stages: Annotated[
        str | None, typer.Option(help="Only these stages, with commas: 'float32,INT8'.")
    ] = None,
    side: Annotated[
        int,
        typer.Option(min=16, max=4096, help="Side in pixels, where a case has none of its own."),
    ] = 96,
    seed: Seed = 0,
    bit_flips: Annotated[
        bool,
        typer.Option(
            "--bit-flips",
            help="Inject bit flips into the INT8 network instead of running hard cases.",
        ),
    ] = False,
    draws: Annotated[
        int,
        typer.Option(
            min=1, max=10_000, help="Injections into each memory at each rate, with --bit-flips."
        ),
    ] = 6,
    sensor: Annotated[
        str, typer.Option(help="Sensor of a shipped network; with --bit-flips also of the patches.")
    ] = SENSOR,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of aerial images for the patches, with --bit-flips; else drawn scenes."
        ),
    ] = None,
    target: Annotated[
        str, typer.Option(help=f"Board that prices the guards, with --bit-flips: {BOARDS}.")
    ] = DEFAULT_TARGET,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Tables as Markdown; with --bit-flips the curves beside it."
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Run hard cases through a network in float32, in INT8, in whole numbers alone and in tiles.

    Prints what holds, the worst measures, the known limitations met, and which sums are proven not
    to overflow. --bit-flips: what flips in weights, shifts, maps and the image cost, and what
    guards gain and cost on the board.
    """
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.quant.calibration import Calibration
    from beers_deploy.results import Table, print_rows
    from beers_deploy.studies.stress.battery import (
        TITLES,
        chosen,
        finding_rows,
        markdown,
        run_battery,
        shown_rows,
    )
    from beers_deploy.studies.stress.bit_flips import flip_curves_svg, flip_rows
    from beers_deploy.studies.stress.cases import CASES
    from beers_deploy.studies.stress.networks import STAGES, open_subject

    _refuse_unused(context, bit_flips)
    picture = out.with_name(f"{out.stem}.svg") if bit_flips and out else None
    sources = (float_model, int8_model, images, *map(Path, (sensor, target)))
    require_writable(out, json, picture, inputs=sources)
    names = chosen(cases, [case.name for case in CASES], "--cases")
    stage_names = chosen(stages, STAGES, "--stages")
    subject = open_subject(float_model, int8_model, sensor)
    inputs = tuple(network.input for network in subject.opened)
    if bit_flips:
        results = []
        table_rows = flip_rows(
            subject, Calibration(load_sensor(sensor), images, draws, side, seed), target
        )
    else:
        results = run_battery(
            subject, [case for case in CASES if case.name in names], stage_names, seed, side
        )
        table_rows = shown_rows(subject, results)
    for table, rows in by_table(table_rows).items():
        print_rows(TITLES[table], rows)
    save(Table("stress", arguments(), inputs, (*table_rows, *finding_rows(results))), json)
    if out is not None:
        write_text(out, markdown(table_rows))
    if picture is not None:
        write_text(picture, flip_curves_svg({subject.opened[-1].name: table_rows}))
    if not bit_flips:
        _judge(table_rows, results)


def _judge(table_rows: Sequence[Row], results: "Sequence[StageResult]") -> None:
    """Say what was not looked at and what failed; exit code 1 where anything did."""
    for reason in dict.fromkeys(result.reason for result in results if result.reason):
        say(f"not looked at: {reason}")
    failed = [result for result in results if result.failed]
    for result in failed:
        say(f"FAILED {result.case.name}, {result.stage}: {result.verdict.removeprefix('FAILED: ')}")
    # A sum that might overflow is a failure, even if no case makes it overflow.
    safe = all(
        row.text["can it overflow int32"] == "no"
        for row in table_rows
        if row.table == "integer layers"
    )
    if not safe:
        say("FAILED: an int32 accumulator might overflow, see the integer layers")
    say(
        f"stress {'passed' if not failed and safe else 'FAILED'}: {len(results)} looks, "
        f"{len(failed)} failed"
    )
    if failed or not safe:
        raise typer.Exit(1)


def _refuse_unused(context: typer.Context, bit_flips: bool) -> None:
    """Refuse the options of the other work of this command."""
    if bit_flips:
        remedy = "leave one of the two out"
        refuse(context, HARD_CASES_ONLY, expected="hard cases", got="--bit-flips", remedy=remedy)
    else:
        expected = "--bit-flips beside it"
        remedy = "add --bit-flips, or leave it out"
        refuse(context, BIT_FLIPS_ONLY, expected=expected, got="hard cases", remedy=remedy)
