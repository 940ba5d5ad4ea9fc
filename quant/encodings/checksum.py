"""The checksum of an INT8 file, by which damage after the file was written is found.

A flipped bit in a weight may cost 1 dB of quality, which the noise of an image hides from the
self-check of a restored image. The checksum finds every one.

It covers nodes, constants, and the two entries of the metadata from which integers are computed.
Others may be added to a file, such as the calibration of an interval.
"""

import hashlib

from onnx import ModelProto, helper, numpy_helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.encodings.description import KEY, SENSOR_BIASES
from beers_deploy.quant.onnx_file import metadata

CHECKSUM = "checksum"
"""The metadata key of the checksum, in hexadecimal."""


def checksum(model: ModelProto) -> str:
    """Compute the SHA-256 of all that determines the integers of an INT8 file, in hexadecimal.

    Args:
        model: the content of the file.
    """
    digest = hashlib.sha256()
    about = metadata(model)
    for key in (KEY, SENSOR_BIASES):
        digest.update(f"{key} {about.get(key, '')}\n".encode())
    for node in model.graph.node:
        digest.update(node.SerializeToString(deterministic=True))
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        digest.update(f"{tensor.name} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def with_damage_of(source: ModelProto, model: ModelProto) -> ModelProto:
    """Return a model that was computed from an INT8 file, damaged if that file is.

    Otherwise its new checksum would cover the damage.

    Args:
        source: the content of the file.
        model: the model that was computed from it, with a checksum of its own.
    """
    if is_damaged(source):
        about = {**metadata(model), CHECKSUM: metadata(source)[CHECKSUM]}
        helper.set_model_props(model, about)
    return model


def is_damaged(model: ModelProto) -> bool:
    """Return True if an INT8 file states a checksum that is not that of its integers.

    A float file, and one that another program wrote, states none.

    Args:
        model: the content of the file.
    """
    stated = metadata(model).get(CHECKSUM)
    return stated is not None and stated != checksum(model)


def require_undamaged(model: ModelProto, name: str) -> None:
    """Raise ModelError if an INT8 file was changed after it was written.

    Args:
        model: the content of the file.
        name: the name of the network, for the message.
    """
    if is_damaged(model):
        raise ModelError(
            f"The INT8 file of {name} is damaged: its integers are not those of its checksum. Copy "
            "the file again, or make it again with 'beers-deploy quantize'."
        )
