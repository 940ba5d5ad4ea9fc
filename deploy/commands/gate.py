"""`beers-deploy gate`: does INT8 stay close enough to float? Exit code 1 when it does not."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import (
    RULED,
    STDOUT,
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
from beers_deploy.profiles.errors import BeersError, OptionError
from beers_deploy.profiles.target import DEFAULT_TARGET

if TYPE_CHECKING:
    from beers_deploy.verdict import Verdict

TITLES = {"gate": "float against INT8", "samples": "what the samples cover"}
"""Of the tables that are shown, by the rows' own."""


def gate(
    context: typer.Context,
    float_model: FloatModel = None,
    int8_model: Int8Model = None,
    max_mae: Annotated[
        float | None,
        typer.Option(help="Largest mean absolute difference, of full scale; 0.0007 if none."),
    ] = None,
    limits: Annotated[
        Path | None, typer.Option(help="TOML file of limits; see docs/how-to/gate.md.")
    ] = None,
    baseline: Annotated[
        Path | None, typer.Option(help="What 'gate --json' wrote before: MAE may not grow.")
    ] = None,
    target: Annotated[
        str, typer.Option(help=f"Board whose rules the INT8 file must keep: {RULED}.")
    ] = DEFAULT_TARGET,
    sensor: Annotated[
        str, typer.Option(help="Sensor of the test patches and of a shipped network.")
    ] = SENSOR,
    images: Annotated[
        Path | None, typer.Option(help="Folder of scenes; drawn ones if none.")
    ] = None,
    samples: Annotated[
        Path | None,
        typer.Option(
            help="Your own samples in their place: .npy or .npz (N, C, H, W), or a folder of "
            "images."
        ),
    ] = None,
    patches: Annotated[
        int, typer.Option(min=1, max=100_000, help="Test patches of 128 x 128.")
    ] = 32,
    metric: Annotated[
        str | None,
        typer.Option(help="Hold results against references too: psnr, ssim, mae, top1 or iou."),
    ] = None,
    seed: Seed = 0,
    junit: Annotated[Path | None, typer.Option(help="Write the verdict here as JUnit XML.")] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for a record of evidence: JSON, a page and an ML-BOM."
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Compare a float and an INT8 network on simulated pairs neither was calibrated on.

    Also checked: what saturates inside, the DPU's rules, that no ReLU was lost, and that
    onnxruntime's optimisations change no bit.
    """
    inputs = (
        float_model,
        int8_model,
        limits,
        baseline,
        images,
        samples,
        *map(Path, (target, sensor)),
    )
    try:
        _clear((json, junit, *_record_files(record)), inputs, record)
        # These are loaded only now: if a library fails, no older verdict is left either.
        from beers_deploy.model.io.files import write_text
        from beers_deploy.network_files import pair_of
        from beers_deploy.quant.limits import limits_of
        from beers_deploy.verdict import gate as judged

        if samples is not None:
            refuse(
                context,
                ("images", "patches", "seed"),
                expected="none together with --samples",
                got="one",
            )
        against, int8 = pair_of(float_model, int8_model)
        allowed = limits_of(limits, max_mae)
        verdict = judged(
            int8,
            against,
            samples,
            board=target,
            limits=allowed,
            baseline=baseline,
            sensor=sensor,
            images=images,
            patches=patches,
            seed=seed,
            metric=metric,
        )
        _show(verdict)
        # The record comes first: its library may fail, and then no other file may have a verdict.
        if record is not None:
            from beers_deploy.kit.record import write_record

            compared = verdict.comparison
            write_record(verdict, compared.int8, compared.sensor, record, compared.floating)
        save(replace(verdict, arguments=arguments(max_mae=allowed.mae)), json)
        if junit is not None:
            write_text(junit, verdict.to_junit())
    except BeersError as error:
        _explain(error, junit, (json, *_record_files(record)), inputs)
        raise
    say(str(verdict))
    if not verdict:
        raise typer.Exit(1)


def _record_files(folder: Path | None) -> list[Path]:
    """Return the files of --record, for which more is loaded than a gate needs."""
    if folder is None:
        return []
    from beers_deploy.kit.record import recorded

    return recorded(folder)


def _clear(
    outputs: Sequence[Path | None], inputs: Sequence[Path | None], record: Path | None
) -> None:
    """Delete older outputs, and require that new ones can be written: a refused gate leaves no
    verdict behind.
    """
    from beers_deploy.model.io.files import require_writable

    for path in outputs:
        if path is not None and path != STDOUT:
            # The error is raised below, when the other outputs are deleted.
            with suppress(BeersError):
                require_writable(path, inputs=inputs)
                path.unlink(missing_ok=True)
    _, junit, *_ = outputs
    if junit == STDOUT:
        raise OptionError(
            "--junit",
            expected="a file",
            got="-",
            remedy="name one: standard output is for --json -",
        )
    require_writable(*outputs, inputs=inputs, folders=(record,))
    if record is not None:
        from beers_deploy.kit.record import require_library

        require_library()


def _explain(
    error: BeersError,
    junit: Path | None,
    others: Sequence[Path | None],
    inputs: Sequence[Path | None],
) -> None:
    """Write the reason why nothing could be judged to the JUnit file, if there is one that may be
    written.
    """
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.verdict import junit_error

    other_outputs = {os.path.realpath(path).casefold() for path in others if path is not None}
    # A file system without regard to case has one file for names that differ in case.
    if junit is None or junit == STDOUT or os.path.realpath(junit).casefold() in other_outputs:
        return
    with suppress(BeersError):
        require_writable(junit, inputs=inputs)
        write_text(junit, junit_error("INT8 gate", str(error)))


def _show(verdict: "Verdict") -> None:
    """Print the figures, the notes and the checks."""
    from beers_deploy.profiles.figures import by_table
    from beers_deploy.results import print_rows

    for title, rows in by_table(verdict.rows).items():
        print_rows(TITLES[title], rows)
    for note in verdict.notes:
        say(f"note: {note}")
    for check in verdict.checks:
        say(f"{'ok    ' if check.passed else 'FAILED'} {check}")
