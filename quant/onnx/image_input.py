"""Read and state the image that a network takes: its axes, channels, and fixed size.

How an image may be cut into tiles for a network is determined in `quant.tiling`.
"""

from collections.abc import Collection, Sequence
from copy import deepcopy

from onnx import ModelProto, TensorProto, ValueInfoProto, helper

from beers_deploy.profiles.errors import ModelError, printable


def fixed_tile_px(model: ModelProto) -> int | None:
    """Return the side in pixels of the square image that a model is fixed to, or None if it accepts
    any size.

    Raises:
        ModelError: the model has not exactly one input, or it is not one image (`require_image`).
    """
    require_one_input([value.name for value in model.graph.input])
    image = model.graph.input[0]
    sizes = [d.dim_value for d in image.type.tensor_type.shape.dim]
    require_image(image.name, sizes)
    return sizes[2] or None


def require_one_input(names: Collection[str]) -> None:
    """Raise ModelError unless a network has exactly one input.

    Args:
        names: the names of its inputs.
    """
    if len(names) != 1:
        raise ModelError(
            f"The network must have one input, the image, but it has {len(names)}: "
            f"{printable(', '.join(names))}. Export it with the others as constants, or as "
            "channels of the image that the network splits."
        )


def require_image(name: str, sizes: Sequence[int], square: bool = True) -> None:
    """Raise ModelError unless an input is one image of stated channels.

    Args:
        name: the name of the input.
        sizes: the sizes that the file states, 0 where it states none.
        square: True to require also that height and width are equal, or both free.
    """
    if len(sizes) != 4 or sizes[0] > 1:
        rule = "be one image (N, C, H, W)"
        remedy = "for one image, or for any number of them"
    elif sizes[1] < 1:
        rule = "state its number of channels, the second size"
        remedy = "with a fixed number of channels"
    elif square and sizes[2] != sizes[3]:
        rule = "have a height and width that are equal or both free"
        remedy = "with free or with equal height and width"
    else:
        return
    raise ModelError(
        f"The input {printable(repr(name))} must {rule}, but its sizes are {list(sizes)} (0 is "
        f"free). Export the network {remedy}."
    )


def any_size(model: ModelProto) -> ModelProto:
    """Return a network that is fixed to one size of image as a network for images of any size.

    Only networks whose inputs and outputs all have the axes (N, C, H, W) can be changed. Others are
    returned unchanged.

    Args:
        model: a network; not changed.
    """
    return model if fixed_tile_px(model) is None else without_size(model)


def without_size(model: ModelProto) -> ModelProto:
    """Return a network without the sizes that its file states, as `any_size` does, also if its
    image is no square.
    """
    copy = deepcopy(model)
    for value in (*copy.graph.input, *copy.graph.output):
        dims = value.type.tensor_type.shape.dim
        # A classifier's result has two sizes, and its image one size only.
        if len(dims) != 4:
            return model
        for side, name in zip(dims[2:], ("H", "W"), strict=True):
            side.dim_param = name
    # Sizes of inner tensors that the file states are those of the fixed tile.
    del copy.graph.value_info[:]
    return copy


def image_info(name: str, channels: int, tile_px: int | None) -> ValueInfoProto:
    """Describe an input or output of a graph that is an image (N, channels, H, W) float32.

    Args:
        name: the name of the tensor.
        channels: the number of its channels.
        tile_px: rows and columns of the one image that the tensor is fixed to; None leaves number
            and size of the images free.
    """
    shape: list[str | int | None] = (
        [1, channels, tile_px, tile_px] if tile_px else ["N", channels, "H", "W"]
    )
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
