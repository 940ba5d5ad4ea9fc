"""Run networks on onnxruntime: a session, set up once for the whole project, and large images in
tiles.

Reading every tensor of a network at once needs memory that grows with the image; tiles do not.
"""

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import onnxruntime as ort
from onnx import ModelProto, helper

from beers_deploy.model.processor import int8_adds_exactly
from beers_deploy.profiles.errors import CODE_FAULTS, ModelError, printable, reason_of
from beers_deploy.quant.graph import (
    PLANES,
    PLANES_FRAC_BITS,
    Add,
    Concat,
    Conv,
    Graph,
    Mul,
    Pointwise,
    same,
)
from beers_deploy.quant.graph.writer import graph_to_onnx
from beers_deploy.quant.host_part import ONE_CHANNEL, HostPart
from beers_deploy.quant.kernels import with_exact_sums, with_wide_convolutions
from beers_deploy.quant.onnx.image_input import any_size
from beers_deploy.quant.onnx_file import is_quantized, load_onnx
from beers_deploy.quant.untrusted import contradictions, times


def open_session(
    model: Path | ModelProto,
    threads: int = 0,
    optimise: bool = True,
) -> ort.InferenceSession:
    """Open a model in onnxruntime on the CPU such that integers are added exactly on every
    processor.

    Some processors' int8 kernels saturate. There the model is rewritten first (`quant.kernels`).

    Args:
        model: a file or a model in memory.
        threads: the number of threads; 0 uses every core.
        optimise: False switches onnxruntime's optimisations off, so that the graph runs as written.

    Raises:
        ModelError: the file cannot be trusted, or onnxruntime rejects it.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    # Planning the memory needs up to 40 % more of it, and saves no time.
    options.enable_mem_pattern = False
    # An error is raised, so onnxruntime need not print it as well.
    options.log_severity_level = 4
    # Threads that wait for this session's next run occupy a core for tens of milliseconds, which
    # other work lacks.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    if not optimise:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    network = model if isinstance(model, ModelProto) else load_onnx(model)
    name = "the network" if isinstance(model, ModelProto) else str(model)
    # This stands outside `contradictions`, because the processor is tested with another network,
    # whose faults are not this file's.
    saturates = is_quantized(network) and not int8_adds_exactly()
    with contradictions(name):
        network = with_wide_convolutions(network) if optimise else network
        if saturates:
            network = with_exact_sums(network)
    try:
        return ort.InferenceSession(
            network.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
    except CODE_FAULTS:
        raise
    except Exception as error:  # onnxruntime raises a class of its own for each status code
        reason = reason_of(error)
        raise ModelError(
            f"onnxruntime cannot run {name}: {reason}. Give a file written by "
            "'beers-deploy export' or 'beers-deploy quantize'."
        ) from error


def open_any_size(model: ModelProto, optimise: bool = True) -> ort.InferenceSession:
    """Open a session that accepts images of any size, even if the file is fixed to one tile.

    Args:
        model: a float or INT8 network.
        optimise: False runs the graph as written.
    """
    return open_session(any_size(model), optimise=optimise)


def run(session: ort.InferenceSession, image: np.ndarray) -> np.ndarray:
    """Restore an image by a network whose result has the shape of its input.

    Args:
        session: a session of the network, as `open_session` returns it.
        image: (N, C, H, W) float32 as the network reads it.

    Returns:
        The restored image, (N, C, H, W) float32.

    Raises:
        ModelError: the model does not run on this image, or returns another shape.
    """
    restored = result_of(session, image)
    if restored.shape != image.shape:
        raise _unfit(f"{times(image.shape)} values give {times(restored.shape)}")
    return restored


def result_of(session: ort.InferenceSession, image: np.ndarray) -> np.ndarray:
    """Run a network on an image, and return its first output, of whatever shape it is.

    Args:
        session: a session of the network, as `open_session` returns it.
        image: (N, C, H, W) float32 as the network reads it.

    Raises:
        ModelError: the model does not run on this image.
    """
    return tensors_of(session, None, image)[0]


def tensors_of(
    session: ort.InferenceSession, names: list[str] | None, image: np.ndarray
) -> list[np.ndarray]:
    """Run a network on an image, and return several of its outputs.

    Args:
        session: a session of the network, as `open_session` returns it.
        names: the names of the outputs, in the order in which they are returned; None for all.
        image: (N, C, H, W) float32 as the network reads it.

    Raises:
        ModelError: the model does not run on this image.
    """
    try:
        values = session.run(names, {session.get_inputs()[0].name: image})
        return [np.asarray(value) for value in values]
    except CODE_FAULTS:
        raise
    except Exception as error:  # as above
        raise _unfit(reason_of(error)) from error


def require_finite(values: Iterable[np.ndarray], name: str) -> None:
    """Raise ModelError if a network returned NaN or infinity for an image.

    Args:
        values: the arrays that the network returned.
        name: the name of the network, with which the message begins.
    """
    # NaN and infinity reach the minimum or the maximum, which need no array of their own.
    if not all(np.isfinite((value.min(), value.max())).all() for value in values):
        raise ModelError(
            f"{name} returns NaN or infinity for an image, because its sums overflow. Train it "
            "again with a lower learning rate, or scale its weights."
        )


def _unfit(reason: str) -> ModelError:
    return ModelError(
        f"The network does not restore an image to its own size: {printable(reason)}. Export it "
        "for images of any size, or check its sizes."
    )


TILE_PX = 128
"""Side of the largest tile, without halo."""


def crops(image: np.ndarray, halo_px: int | None = 0) -> list[np.ndarray]:
    """Cut an image into tiles without overlap, about equally large, of at most TILE_PX a side.

    Args:
        image: (1, C, H, W).
        halo_px: the halo of the network as `halo_of` returns it; only None matters. A network
            without a halo cannot be run on tiles, so the whole image is the only crop.

    Returns:
        Views (1, C, h, w) of the image.
    """
    return [image[..., slice(*rows), slice(*columns)] for rows, columns in _places(image, halo_px)]


def tensor_values(
    session: ort.InferenceSession,
    names: list[str],
    image: np.ndarray,
    halo_px: int | None,
    host_part: HostPart = ONE_CHANNEL,
) -> Iterator[list[np.ndarray]]:
    """Compute inner tensors of a float network for an image, tile by tile, so that memory is
    bounded.

    Each tile is computed with a halo of the pixels that its values depend on, which is then cut
    off. The tiles together equal the result of the whole image, zero-padded borders included.

    Args:
        session: a float network that reads the planes of an image (`planes_of`), not the image
            itself.
        names: the names of the tensors.
        image: (1, C', H, W) in the network's units.
        halo_px: the halo as `halo_of` returns it. With None the image is one tile.
        host_part: the host's processing, which makes planes of the image.

    Yields:
        For each tile the tensors (1, C, h, w) in the order of `names`.
    """
    # Tensors around a mirrored border are larger than the image.
    halo_px = None if host_part.border_px else halo_px
    for (top, bottom), (left, right) in _places(image, halo_px):
        around_px = halo_px or 0
        above = min(top, around_px)
        before = min(left, around_px)
        # A slice ends at the image's own border, where the network pads with zeros as it would.
        with_halo = image[..., top - above : bottom + around_px, left - before : right + around_px]
        values = session.run(names, {PLANES: planes_of(with_halo, host_part)})
        if halo_px is not None:
            inner = ..., slice(above, above + bottom - top), slice(before, before + right - left)
            values = [result[inner] for result in values]
        require_finite(values, "The float network")
        yield values


def values_of(
    graph: Graph, names: list[str], images: Iterable[np.ndarray], host_part: HostPart = ONE_CHANNEL
) -> Iterator[list[np.ndarray]]:
    """Compute inner tensors of a float graph for several images, tile by tile.

    Args:
        graph: a float graph that reads the planes of an image (`planes_of`).
        names: the names of the tensors.
        images: (1, C', H, W) in the network's units.
        host_part: the host's processing, which makes planes of the images.

    Yields:
        For each tile of each image the tensors (1, C, h, w) in the order of `names`.
    """
    session = open_session(graph_to_onnx(graph, names, host_part.planes))
    for image in images:
        yield from tensor_values(session, names, image, halo_of(graph), host_part)


def planes_of(image: np.ndarray, host_part: HostPart = ONE_CHANNEL) -> np.ndarray:
    """Encode an image as the float32 values of the int8 planes that a core reads.

    Args:
        image: (N, C, H, W) in the network's units.
        host_part: the host's processing, which encodes the image.

    Returns:
        (N, P, H', W') float32, multiples of 2^-PLANES_FRAC_BITS, with P as in `HostPart.planes`.
    """
    return host_part.encode(image).astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)


def halo_of(graph: Graph) -> int | None:
    """Return the halo by which a graph can be run on tiles: the farthest pixel that a value depends
    on.

    It is the sum of the pads of all convolutions, which no path exceeds.

    Args:
        graph: a float graph.

    Returns:
        The number of pixels on each side. None if the graph cannot be run on tiles, because it has
        other operations than adds, products, concats, activations and convolutions that preserve
        the size.
    """
    halo_px = 0
    for op in graph:
        if isinstance(op, Conv) and not op.transposed and op.window == same(op.weight):
            halo_px += max(op.window.pads)
        elif not isinstance(op, Add | Mul | Concat | Pointwise):
            return None
    return halo_px


def _places(
    image: np.ndarray, halo_px: int | None
) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Return (top, bottom) and (left, right) of every tile, all about equally large.

    Without a halo there is one tile, the whole image.
    """
    counts = [-(-size // TILE_PX) if halo_px is not None else 1 for size in image.shape[-2:]]
    edges = [
        [size * k // n for k in range(n + 1)]
        for size, n in zip(image.shape[-2:], counts, strict=True)
    ]
    return product(*map(pairwise, edges))


def with_outputs(model: ModelProto, kinds: Mapping[str, int]) -> ModelProto:
    """Return a copy of a model that also returns some of its inner tensors.

    Args:
        model: any model; not changed.
        kinds: ONNX's number of the element type of each tensor, by the tensor's name.
    """
    extended = deepcopy(model)
    names = {value.name for value in extended.graph.output}
    extended.graph.output.extend(
        helper.make_tensor_value_info(name, kind, None)
        for name, kind in kinds.items()
        if name not in names
    )
    return extended
