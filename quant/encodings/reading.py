"""An INT8 file of the legal regime read back: its core as numbers to reason about, and whether it says what they ask.

A file describes its operations in its metadata, without weights and scales: those are its nodes' own. What is read is
written again, so that any node or constant which differs from what the numbers ask for is a fault.
"""

import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings.description import KEY, described_core
from beers_deploy.quant.encodings.host import host_model
from beers_deploy.quant.onnx_file import constants, fixed_tile_px, metadata
from beers_deploy.quant.untrusted import contradictions


def read_core(model: onnx.ModelProto) -> IntCore:
    """The core of an INT8 file of the legal regime.

    Raises:
        ModelError: a file that describes none.
    """
    said = metadata(model).get(KEY)
    if said is not None:
        with contradictions("INT8 model"):
            return described_core(said, constants(model))
    expected, remedy = "a file that describes its integers", "make it with 'beers-deploy quantize --regime legal'"
    raise ModelError("INT8 core", expected=expected, got="one that does not", remedy=remedy)


def encoding_faults(model: onnx.ModelProto) -> list[str] | None:
    """Where a file of the legal regime is not what its integers ask for: the host's ends, ReLUs, a reader's scale.

    None for files of others.
    """
    try:
        core = read_core(model)
    except ModelError as error:
        return [error.got] if metadata(model).get("precision") == "int8 legal" else None
    with contradictions("INT8 model"):
        meant, faults = host_model(core, {}, fixed_tile_px(model)).graph, list[str]()
    for kind, found, wanted in (
        ("constant", model.graph.initializer, meant.initializer),
        ("node", model.graph.node, meant.node),
    ):
        faults += [f"{kind} {a.name}" for a, b in zip(found, wanted, strict=False) if a != b]
        faults += [f"{len(found)} {kind}s instead of {len(wanted)}"] if len(found) != len(wanted) else []
    return faults
