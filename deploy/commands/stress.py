"""`beers-deploy stress`: hard cases and bit flips against a network. Exit code 1 when something fails."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import BOARDS, arguments, refuse, save, say
from beers_deploy.model.processor import SEEDS
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import by_table
from beers_deploy.profiles.target import DEFAULT_TARGET

if TYPE_CHECKING:
    from beers_deploy.studies.stress.bit_flips import FlipRequest
    from beers_deploy.studies.stress.networks import Subject

EXAMPLE = "stress float.onnx int8.onnx --out stability.md"


HARD_CASES_ONLY = ("cases", "stages")
BIT_FLIPS_ONLY = ("draws", "images", "target")


def stress(
    context: typer.Context,
    float_model: Annotated[
        Path | None,
        typer.Argument(metavar="[FLOAT]", help="Float ONNX or weights; or a shipped name, convbeers-s if none."),
    ] = None,
    int8_model: Annotated[
        Path | None, typer.Argument(metavar="[INT8]", help="Its INT8 ONNX; that of a shipped name if none.")
    ] = None,
    cases: Annotated[str | None, typer.Option(help="Only these cases, with commas: 'night,snow'.")] = None,
    stages: Annotated[str | None, typer.Option(help="Only these stages, with commas: 'float32,INT8'.")] = None,
    side: Annotated[
        int, typer.Option(min=16, max=4096, help="Side in pixels, where a case has none of its own.")
    ] = 96,
    seed: Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of every random draw.")] = 0,
    bit_flips: Annotated[
        bool,
        typer.Option("--bit-flips", help="Inject bit flips into the INT8 network instead of running hard cases."),
    ] = False,
    draws: Annotated[
        int, typer.Option(min=1, max=10_000, help="Injections into each memory at each rate, with --bit-flips.")
    ] = 6,
    sensor: Annotated[
        str, typer.Option(help="What a shipped network is told; with --bit-flips also what sees the patches.")
    ] = SENSOR,
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of aerial images for the patches, with --bit-flips; else drawn scenes."),
    ] = None,
    target: Annotated[
        str, typer.Option(help=f"Board that prices the guards, with --bit-flips: {BOARDS}.")
    ] = DEFAULT_TARGET,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Tables as Markdown; with --bit-flips the curves beside it.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Run hard cases through a network in float32, in INT8, in whole numbers alone and in tiles.

    Prints what holds, the worst measures, the known limitations met, and which sums are proven not to overflow. With
    --bit-flips: what bit flips in weights, shifts, maps and the image cost, what guards buy back, and what
    these cost on the board.
    """
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.results import Table, print_rows
    from beers_deploy.studies.stress.battery import (
        battery_rows,
        chosen,
        finding_rows,
        layer_rows,
        limitation_rows,
        overflow_proven,
        run_battery,
        worst_rows,
    )
    from beers_deploy.studies.stress.bit_flips import FlipRequest
    from beers_deploy.studies.stress.cases import CASES
    from beers_deploy.studies.stress.networks import STAGES, open_subject
    from beers_deploy.studies.stress.tables import markdown, title

    _refuse_unused(context, bit_flips)
    picture = _picture_beside(out, json) if bit_flips else None
    read = (float_model, int8_model, images, *map(Path, (sensor, target)))
    require_writable(out, json, picture, inputs=read)
    files, tell = (float_model, int8_model), partial(say, err=True)
    if bit_flips:
        request = FlipRequest(sensor, images, target, draws, side, seed)
        _flip_bits(open_subject(*files, sensor, tell), request, (out, picture, json))
        return
    names = chosen(cases, [case.name for case in CASES], "--cases")
    wanted = chosen(stages, STAGES, "--stages")
    subject = open_subject(*files, sensor, tell)
    selected = [case for case in CASES if case.name in names]
    results = run_battery(subject, selected, wanted, seed, side)
    shown = [*battery_rows(results), *worst_rows(results), *limitation_rows(results), *layer_rows(subject)]
    for table, rows in by_table(shown).items():
        print_rows(title(table), rows)
    save(Table("stress", arguments(), subject.paths, (*shown, *finding_rows(results))), json)
    if out is not None:
        write_text(out, markdown(shown))
    for reason in dict.fromkeys(result.reason for result in results if result.reason):
        say(f"not looked at: {reason}")
    failed = [result for result in results if result.failed]
    for result in failed:
        say(f"FAILED {result.case.name}, {result.stage}: {result.verdict.removeprefix('FAILED: ')}")
    safe = overflow_proven(subject)
    if not safe:
        say("FAILED: an int32 accumulator might overflow, see the integer layers")
    say(f"stress {'passed' if not failed and safe else 'FAILED'}: {len(results)} looks, {len(failed)} failed")
    if failed or not safe:
        raise typer.Exit(1)


def _refuse_unused(context: typer.Context, bit_flips: bool) -> None:
    """Refuse the options of the other work of this command."""
    if bit_flips:
        remedy = "leave one of the two out"
        refuse(context, HARD_CASES_ONLY, expected="hard cases", got="--bit-flips", remedy=remedy)
    else:
        expected, remedy = "--bit-flips beside it", "add --bit-flips, or leave it out"
        refuse(context, BIT_FLIPS_ONLY, expected=expected, got="hard cases", remedy=remedy)


def _flip_bits(
    subject: "Subject", request: "FlipRequest", wanted: tuple[Path | None, Path | None, Path | None]
) -> None:
    """Inject, print, and write what was asked for: tables, curves, figures."""
    from beers_deploy.model.io.files import write_text
    from beers_deploy.results import Table, print_rows
    from beers_deploy.studies.stress.bit_flips import flip_curves_svg, flip_rows
    from beers_deploy.studies.stress.tables import markdown, title

    out, picture, json = wanted
    rows = flip_rows(subject, request)
    for table, found in by_table(rows).items():
        print_rows(title(table), found)
    save(Table("stress", arguments(), subject.paths, tuple(rows)), json)
    if out is not None and picture is not None:
        write_text(out, markdown(rows))
        write_text(picture, flip_curves_svg({subject.paths[-1].stem: rows}))


def _picture_beside(out: Path | None, json: Path | None) -> Path | None:
    """Where the curves go: beside the tables, over nothing else that is written."""
    if out is None:
        return None
    picture = out.with_name(f"{out.stem}.svg")
    if picture in (out, json):
        expected, remedy = f"a name other than that of the curves, {picture.name}", "give it the suffix .md"
        raise OptionError("--out", expected=expected, got=out.name, remedy=remedy)
    return picture
