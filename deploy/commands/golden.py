"""`beers-deploy golden`: the integers that every layer must write on a board, and what is wrong
where it does not.
"""

from pathlib import Path
from typing import Annotated, cast

import typer

from beers_deploy.commands.shared import BOARDS, Json, refuse, save, say
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.target import DEFAULT_TARGET


def golden(
    context: typer.Context,
    given: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="INT8 ONNX or a shipped name; with --compare the results."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write the vectors to.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of vectors: hold a board's results against them."),
    ] = None,
    tile: Annotated[
        int | None,
        typer.Option(min=1, max=4096, help="Tile side in pixels; the network's own, else 64."),
    ] = None,
    target: Annotated[
        str, typer.Option(help=f"Whose way to round ties is taken: {BOARDS}.")
    ] = DEFAULT_TARGET,
    json: Json = None,
) -> None:
    """Write inputs and the exact int8 tensors of every layer, or compare what a board wrote.

    A comparison names the first layer that differs, by how much and where, and the fault that gives
    just these numbers. Any subset of the layers will do. Exit code 1 if a layer differs.
    """
    from beers_deploy.kit.golden import compare_golden, write_golden
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.network_files import in_int8
    from beers_deploy.results import print_rows

    inputs = given, compare, Path(target)
    require_writable(json, out / "golden.json" if out else None, inputs=inputs, folders=(out,))
    if compare is None:
        refuse(
            context, ("json",), expected="--compare beside it", remedy="leave it out, or compare"
        )
    if (out is None) == (compare is None):
        expected = "one of --out and --compare"
        remedy = "give the folder to write, or the folder to compare with"
        raise OptionError("out", expected=expected, got="both" if out else "none", remedy=remedy)
    if compare is None:
        say(f"wrote {write_golden(in_int8(given), cast('Path', out), tile=tile, board=target)}")
        return
    refuse(context, ("tile", "target"), expected="none with --compare", got="one")
    table = compare_golden(compare, given)
    print_rows(f"{given.name} against {compare.name}", list(table.rows))
    save(table, json)
    for check in table.checks:
        say(check.detail or f"no layer differs: {len(table.rows)} compared")
    if not table:
        raise typer.Exit(1)
