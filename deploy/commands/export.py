"""`beers-deploy export`: weights to a float ONNX file, and proof that both compute the same."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import RULED, board_for, refuse, save_core, say
from beers_deploy.model.shipped import INT8, SENSOR, SHIPPED, VARIANT, shipped_weights
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, TargetProfile

if TYPE_CHECKING:
    import onnx


def export(
    context: typer.Context,
    out: Annotated[Path, typer.Option("-o", "--out", help="ONNX file to write.")],
    network: Annotated[
        Path,
        typer.Option(
            help="A shipped name, also with -int8; your own weights (.safetensors); or an INT8 "
            "file that 'quantize' "
            "made of weights of 'train --conditioned'."
        ),
    ] = Path(VARIANT),
    sensor: Annotated[
        str | None,
        typer.Option(
            help=f"Sensor of the network: a profile, your .toml file, or blind; {SENSOR} if none."
        ),
    ] = None,
    tile: Annotated[
        int | None,
        typer.Option(
            min=16, max=8192, help="Fix the input to one tile of this side, 640 for a board."
        ),
    ] = None,
    board_file: Annotated[
        Path | None,
        typer.Option(help="Of an INT8 file: also write its integers in the board's encoding."),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(help=f"Whose encoding --board-file has, QDQ ONNX or an NPU's VINT8: {RULED}."),
    ] = None,
    delta: Annotated[
        Path | None,
        typer.Option(
            help="Of an INT8 file: also write what the sensor changes in it, 1 to 3 kB; for the "
            "exposures of "
            "'restore', -x4 and so on before the suffix."
        ),
    ] = None,
    apply: Annotated[
        Path | None,
        typer.Option(
            help="Of an INT8 file: tell it the sensor of this delta, in place of --sensor."
        ),
    ] = None,
) -> None:
    """Write the network as ONNX, any height and width unless --tile fixes them.

    Weights of your own are checked against torch; the project's tests do that with all shipped
    ones. Conditioned weights, as all shipped ones are, become the network of one sensor: of a
    profile with ranges, for the middle of each. A value outside the trained range is taken as the
    nearest end of it, with a warning.

    An INT8 file of conditioned weights (--network FILE.onnx) is told another sensor without being
    calibrated anew. --delta writes what the sensor changes, and --apply makes the file of any
    sensor that sensor's, to the byte. 'restore' restores dark parts at higher exposures, by the
    network of a sensor of 2, 4 or 8 times the gain. So --delta my.delta also writes my-x4.delta and
    my-x8.delta: one file for each factor that the sensor's noise allows.
    """
    from beers_deploy.export import about, float_for, to_onnx
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.model.io.tensors import is_conditioned, read_conditioned, read_plain
    from beers_deploy.network_files import warn_outside, weights_file
    from beers_deploy.quant.onnx_file import require_onnx_name, save_onnx

    if not (network.suffix or network.exists()):
        # This refuses names under which nothing is shipped.
        shipped_weights(network.name.removesuffix(INT8))
    path = weights_file(network)
    inputs = [path, apply, *(Path(name) for name in (sensor, target) if name)]
    require_writable(out, board_file, delta, inputs=inputs)
    deltas = _delta_files(delta, sensor)
    require_writable(out, board_file, *deltas.values(), inputs=inputs)
    if board_file is None:
        refuse(context, ["target"], expected="--board-file beside it")
    if path.suffix != ".onnx":
        remedy = (
            "give one that 'quantize' made of weights of 'train --conditioned', or leave it out"
        )
        options = ["board_file", "delta", "apply"]
        refuse(context, options, expected="an INT8 --network", got=str(network), remedy=remedy)
    require_onnx_name(out, board_file)
    board = board_for(target or DEFAULT_TARGET, board_file, tile, inputs)
    if path.suffix == ".onnx":
        _export_int8(path, out, sensor, tile, (board_file, board), deltas, apply)
        return
    profile = load_sensor(sensor or SENSOR) if is_conditioned(path) else None
    if profile is not None:
        warn_outside(profile, read_conditioned(path).kernels, partial(say, err=True))
        model = float_for(path, path.stem, profile, tile)
    elif sensor is not None:
        expected = "weights of 'train --conditioned'"
        remedy = "leave --sensor out, or give such weights"
        raise ModelError(
            str(path), expected=expected, got="those of a plain network", remedy=remedy
        )
    else:
        weights = read_plain(path)
        model = to_onnx(weights, about(path.stem, weights.recipe), tile)
    if path.parent == SHIPPED:
        save_onnx(model, out)
        say(f"wrote {out}")
        return
    # It loads torch, which shipped networks do without.
    from beers_deploy.parity import require_parity, torch_network

    reference = torch_network(path, profile.nominal() if profile else None)
    difference = require_parity(reference, model, tile or 97)
    save_onnx(model, out)
    say(f"wrote {out}: largest difference from torch {difference:.2g} of full scale (measured)")


def _delta_files(delta: Path | None, sensor: str | None) -> dict[int, Path]:
    """Return the files that --delta writes by factor: the one named at 1, and one for each higher
    exposure.
    """
    from beers_deploy.model.exposure import factors_for

    if delta is None:
        return {}
    factors = factors_for(load_sensor(sensor or SENSOR).nominal())
    higher = {
        factor: delta.with_name(f"{delta.stem}-x{factor}{delta.suffix}")
        for factor in factors
        if factor > 1
    }
    return {1: delta, **higher}


def _export_int8(
    path: Path,
    out: Path,
    sensor: str | None,
    tile_px: int | None,
    board: tuple[Path | None, TargetProfile],
    deltas: dict[int, Path],
    apply: Path | None,
) -> None:
    """Write an INT8 file conditioned on a sensor, or on that of a delta.

    Args:
        path: an INT8 file.
        out: the file to write.
        sensor: a profile's name or file; the default one if None.
        tile_px: side of the tile that `out` is fixed to.
        board: the file that its integers go to, if any, and the board whose encoding they have.
        deltas: the deltas to write, by the factor of their exposure.
        apply: a delta to read in place of the sensor.
    """
    from beers_deploy.export import require_tile
    from beers_deploy.network import Network
    from beers_deploy.network_files import told_by_delta, told_int8
    from beers_deploy.quant.encodings import host_model, read_core
    from beers_deploy.quant.onnx_file import fixed_tile_px, load_onnx, metadata, save_onnx

    if apply is not None and (sensor or deltas):
        remedy = "leave one out: the delta brings its sensor"
        raise OptionError(
            "--apply", expected="no --sensor or --delta beside it", got="one", remedy=remedy
        )
    model = load_onnx(path)
    if apply is not None:
        network = told_by_delta(model, apply)
    else:
        network = told_int8(model, load_sensor(sensor or SENSOR), log=partial(say, err=True))
    core = read_core(network)
    about = metadata(network)
    side_px = tile_px or fixed_tile_px(network)
    require_tile(side_px, core.ends.place_px)
    board_file, profile = board
    for_board = Network(network, out.stem).core(profile, tile_px) if board_file else None
    save_onnx(host_model(core, about, side_px), out)
    say(f"wrote {out}")
    save_core(for_board, board_file, profile)
    for factor, delta in deltas.items():
        _save_delta(network, load_sensor(sensor or SENSOR), factor, delta)


def _save_delta(network: "onnx.ModelProto", sensor: Sensor, factor: int, delta: Path) -> None:
    """Write the delta of an INT8 network that is conditioned on a sensor, at
    one of its exposures.
    """
    from beers_deploy.model.exposure import brightened
    from beers_deploy.model.io.files import whole_file
    from beers_deploy.network_files import told_int8
    from beers_deploy.quant.banked.family import delta_of_file

    # Nobody chose the sensors of the other exposures, so their warnings are not printed.
    model = network if factor == 1 else told_int8(network, brightened(sensor, factor))
    packed = delta_of_file(model)
    with whole_file(delta) as temporary:
        temporary.write_bytes(packed)
    say(f"wrote {delta}: {len(packed)} bytes")
