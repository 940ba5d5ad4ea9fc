"""`golden`: the integers that every layer must write on a board."""

from typing import TYPE_CHECKING, Annotated

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    Holds,
    InputPath,
    Interval,
    NetworkLike,
    OutputFolder,
    TargetLike,
)
from beers_deploy.verbs.verb import changed, refuse_with, verb

if TYPE_CHECKING:
    from beers_deploy.results import Table


INDEX = "golden.json"


@verb
def golden(
    network: NetworkLike,
    *,
    out: Annotated[OutputFolder, Holds(INDEX, folders=("",))] | None = None,
    compare: InputPath | None = None,
    tile: Annotated[int, Interval(ge=1, le=4096)] | None = None,
    target: TargetLike = DEFAULT_TARGET,
) -> "Table":
    """Write golden vectors of an INT8 network, or compare a board's results with them.

    The vectors are inputs and the exact int8 tensors of every layer. A comparison names the first
    layer that differs, by how much and where; results of some layers are enough. The command exits
    with 1 if a layer differs.

    Args:
        network: INT8 ONNX or a shipped name; with `compare` the folder of a board's results.
        out: folder to write the vectors to.
        compare: folder of vectors that the results are compared with.
        tile: side of a tile in pixels; the network's own if it has one, else 64.
        target: board or NPU whose rounding of ties is used: name or .toml file.

    Returns:
        A table of the cases that were written; or of the layers that were compared, which is true
        if none differs.

    Raises:
        ModelError: a network without integers.
        OptionError: neither or both of `out` and `compare`, or a folder that holds no vectors.
        ImageError: results of other shapes or types.
    """
    from beers_deploy.kit.golden import vectors_table, write_golden
    from beers_deploy.kit.golden_results import compare_golden

    if compare is not None:
        options = changed(golden, locals(), "out", "tile", "target")
        refuse_with("`compare`", **options)
        return compare_golden(compare, str(network))
    if out is None:
        raise OptionError(
            "Neither `out` nor `compare` is given. Name the folder to write, or the folder to "
            "compare with."
        )
    return vectors_table(write_golden(network, out, tile=tile, target=target))
