"""Write a core as one C99 file with the function `run`."""

import math
from importlib.resources import files

from beers_deploy.quant.c_code.layers import LayerWriter, Shape, comment, plain
from beers_deploy.quant.c_code.memory import share_buffers
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import board_model
from beers_deploy.quant.graph import CORRECTION, PLANES
from beers_deploy.quant.untrusted import times

KERNELS = (
    "common",
    "window",
    "convolve",
    "add",
    "multiply",
    "concatenate",
    "look_up",
    "pool_maxima",
    "pool_means",
    "repeat",
    "interpolate",
    "shuffle",
    "to_pixels",
    "to_channels",
)
"""The order of the functions in the file."""


def c_program(core: IntCore, tile_px: int, title: str) -> str:
    """Return the text of a C99 file that computes a core on one tile.

    Its function `run` reads planes (P, H, W) int8 and writes the result (C, H', W') int8, in the
    layout of the golden vectors of a kit. It rounds ties up, as a DPU does.

    Args:
        core: the integer core.
        tile_px: side of the tile of the image in pixels.
        title: a text on where the core comes from, for the first comment.

    Raises:
        ModelError: sums that are too large for int32.
    """
    shapes = _shapes(core, tile_px)
    writer = LayerWriter(core, shapes)
    for k, op in enumerate(core.ops):
        writer.write(k + 1, op)
    sizes = {name: math.prod(shape) for name, shape in shapes.items()}
    number, buffers = share_buffers(core, sizes)
    scratch = 2 * (writer.line_length + writer.weights_length)
    head = comment(
        f"{plain(title)}.",
        f"The integer core of the network, for one tile of {tile_px} x {tile_px} pixels. It reads "
        f"`in`, {times(shapes[PLANES])} planes, and writes `out`, {times(shapes[CORRECTION])}: "
        "int8, channel by channel, each row by row.",
        f"Static memory: {writer.constant_bytes} bytes of constants, {sum(buffers)} bytes of maps "
        f"in {len(buffers)} buffers, {scratch} bytes of scratch. No heap. A call does not depend "
        "on the calls before it, and calls must not overlap.",
    )
    folder = files(__package__) / "kernels"
    maps = [
        f"static const struct map map_{k} = {{buffer_{number[name]}, {rows}, {columns}, "
        f"{channels}}}; /* {plain(name)} */"
        for k, (name, (channels, rows, columns)) in enumerate(shapes.items())
    ]
    calls = [
        f"from_planes(in, {writer.maps[PLANES]});",
        *writer.calls,
        f"to_planes({writer.maps[CORRECTION]}, out);",
    ]
    body = "\n".join(f"    {line}" for line in calls)
    parts = [
        head,
        "#include <stdint.h>",
        "void run(const int8_t *in, int8_t *out);",
        f"enum {{ LINE_LENGTH = {writer.line_length}, WEIGHTS_LENGTH = {writer.weights_length} }};",
        *(
            (folder / f"{name}.c").read_text(encoding="utf-8").rstrip()
            for name in KERNELS
            if name in writer.kernels
        ),
        "\n".join(f"static int8_t buffer_{k}[{size}];" for k, size in enumerate(buffers)),
        "\n".join(maps),
        "\n\n".join(writer.constants),
        f"void run(const int8_t *in, int8_t *out)\n{{\n{body}\n}}",
    ]
    return "\n\n".join(parts) + "\n"


def _shapes(core: IntCore, tile_px: int) -> dict[str, Shape]:
    """Return the shape of every tensor, without the batch.

    Args:
        core: the integer core.
        tile_px: side of the tile of the image in pixels.

    Returns:
        Channels, rows and columns by name, the planes first and then in the order of the
        operations.
    """
    graph = board_model(core, {}, tile_px).graph
    values = (*graph.value_info, *graph.output, *graph.input)
    sizes = {
        value.name: tuple(dim.dim_value for dim in value.type.tensor_type.shape.dim[1:])
        for value in values
    }
    return {name: sizes[name] for name in (PLANES, *(op.output for op in core.ops))}
