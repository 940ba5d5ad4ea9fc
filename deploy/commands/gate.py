"""`beers-deploy gate`: does INT8 stay close enough to float? Exit code 1 when it does not."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import RULED, STDOUT, FloatModel, Int8Model, Json, Seed, arguments, save, say
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.target import DEFAULT_TARGET


def gate(
    float_model: FloatModel = None,
    int8_model: Int8Model = None,
    max_mae: Annotated[
        float | None, typer.Option(min=0, help="Largest mean absolute difference, of full scale; 0.0007 if none.")
    ] = None,
    limits: Annotated[Path | None, typer.Option(help="TOML file of limits; see docs/how-to/gate.md.")] = None,
    baseline: Annotated[Path | None, typer.Option(help="What 'gate --json' wrote before: MAE may not grow.")] = None,
    target: Annotated[
        str, typer.Option(help=f"Board whose rules the INT8 file must keep: {RULED}.")
    ] = DEFAULT_TARGET,
    sensor: Annotated[str, typer.Option(help="Sensor of the test patches and of a shipped network.")] = SENSOR,
    images: Annotated[Path | None, typer.Option(help="Folder of scenes; drawn ones if none.")] = None,
    samples: Annotated[
        Path | None,
        typer.Option(help="Your own samples in their place: .npy or .npz (N, C, H, W), or a folder of images."),
    ] = None,
    patches: Annotated[int, typer.Option(min=1, max=100_000, help="Test patches of 128 x 128.")] = 32,
    metric: Annotated[
        str | None, typer.Option(help="Hold results against references too: psnr, ssim, mae, top1 or iou.")
    ] = None,
    seed: Seed = 0,
    junit: Annotated[Path | None, typer.Option(help="Write the verdict here as JUnit XML.")] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for a record of evidence: JSON, a page and an ML-BOM.")
    ] = None,
    json: Json = None,
) -> None:
    """Compare a float and an INT8 network on simulated pairs neither was calibrated on.

    Also checked: what saturates inside, the DPU's rules, that no ReLU was lost, and that onnxruntime's optimisations
    change no bit.
    """
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.network import Network
    from beers_deploy.network_files import pair_of
    from beers_deploy.quant.gate import limits_of
    from beers_deploy.results import print_rows
    from beers_deploy.verdict import gate as judged

    read = (float_model, int8_model, limits, baseline, images, samples, *map(Path, (target, sensor)))
    if junit == STDOUT:
        raise OptionError("--junit", expected="a file", got="-", remedy="name one: standard output is for --json -")
    beside: list[Path] = []
    if record is not None:  # for which more is loaded than a gate needs
        from beers_deploy.kit.record import recorded, write_record

        beside = recorded(record)
    require_writable(json, junit, *beside, inputs=read, folders=(record,))
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
    print_rows("float against INT8", verdict.rows)
    for note in verdict.notes:
        say(f"note: {note}")
    for check in verdict.checks:
        say(f"{'ok    ' if check.passed else 'FAILED'} {check}")
    save(replace(verdict, arguments=arguments(max_mae=allowed.mae)), json)
    if junit is not None:
        write_text(junit, verdict.to_junit())
    if record is not None:
        write_record(verdict, Network.load(int8, sensor=sensor), record)
    say(str(verdict))
    if not verdict:
        raise typer.Exit(1)
