"""Write a core as one C99 file with the function `run`.

Tensors that are never needed at the same time share a static buffer.
"""

import math
from collections.abc import Mapping
from importlib.resources import files

from beers_deploy.quant.c_code.layers import LayerWriter, Shape, comment, plain
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import board_model
from beers_deploy.quant.graph import CORRECTION, PLANES, Add, Mul, Op, Pointwise
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


IN_PLACE = (Add, Mul, Pointwise)
"""Operations that read of each input of the result's size only the value at the position that they
write. A product may read a smaller one too, a factor for each channel.
"""


def share_buffers(core: IntCore, sizes: Mapping[str, int]) -> tuple[dict[str, int], list[int]]:
    """Assign a static buffer to each tensor of a core, so that the C code needs little memory.

    Tensors that are not needed at the same time share a buffer.

    Args:
        core: the integer core.
        sizes: the sizes of the tensors in bytes, by name.

    Returns:
        The number of each tensor's buffer by the tensor's name, and the size of each buffer in
        bytes.
    """
    steps = list(enumerate(core.ops))
    last_use = {PLANES: 0} | {op.output: k for k, op in steps}
    for k, op in steps:
        last_use |= dict.fromkeys(op.inputs, k)
    # The result is read after the last operation, when `run` copies it to `out`.
    last_use[CORRECTION] = len(steps)
    number = {PLANES: 0}
    buffers = [sizes[PLANES]]
    free = set[int]()
    for k, op in steps:
        ending = {number[name] for name in op.inputs if last_use[name] == k}
        size = sizes[op.output]
        over = {number[name] for name in op.inputs if last_use[name] == k and sizes[name] == size}
        chosen = _choose(op, over, free, buffers, size)
        number[op.output] = chosen
        free |= ending | {chosen}
        # A result that nothing reads leaves its buffer free at once.
        if last_use[op.output] > k:
            free.remove(chosen)
    return number, buffers


def _choose(op: IntConv | Op, over: set[int], free: set[int], buffers: list[int], size: int) -> int:
    """Return the number of the buffer for a result, and make the buffer large enough.

    1. An operation that works value by value writes over an input that nothing reads later.
    2. Others take the smallest free buffer that is large enough,
    3. or else enlarge the largest free one,
    4. or else add one.

    Args:
        op: the operation that writes the result.
        over: buffers of its inputs of that size that no later operation reads.
        free: buffers that hold no tensor which is read from here on.
        buffers: the sizes of all buffers in bytes, which are extended in place.
        size: the size of the result in bytes.
    """
    if isinstance(op, IN_PLACE) and over:
        return min(over)
    if not free:
        buffers.append(size)
        return len(buffers) - 1
    by_size = sorted(free, key=buffers.__getitem__)
    chosen = next((k for k in by_size if buffers[k] >= size), by_size[-1])
    buffers[chosen] = max(buffers[chosen], size)
    return chosen
