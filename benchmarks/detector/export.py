"""The detector as an ONNX file in the raw layout that Ultralytics writes: `images` to `output0`, and metadata.

Layout and metadata as its exporter's (ultralytics/engine/exporter.py, read for its format; no code is taken from it).
"""

import io
import warnings
from collections.abc import Mapping, Sequence

import onnx
import torch

from benchmarks.detector.network import MULTIPLE_PX, Decoding, DetectorNetwork

OPSET = 17


def detector_to_onnx(
    network: DetectorNetwork, names: Sequence[str], side_px: int, about: Mapping[str, str]
) -> onnx.ModelProto:
    """A detector as ONNX: `images` (1, 3, S, S) RGB in [0, 1] to `output0` (1, 4 + classes, S * S / 16).

    A column of the output holds cx, cy, w, h in input pixels, then a score in [0, 1] for each class. Batch
    normalisation is folded into the convolutions.

    Args:
        network: trained.
        names: of the classes, in the network's order.
        side_px: S, a multiple of 8.
        about: further metadata.
    """
    buffer, image = io.BytesIO(), torch.zeros(1, 3, side_px, side_px)
    with warnings.catch_warnings():
        # The newer exporter wants onnxscript, a package more.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            Decoding(network).eval(),
            (image,),
            buffer,  # type: ignore[arg-type]
            input_names=["images"],
            output_names=["output0"],
            opset_version=OPSET,
            dynamo=False,
        )
    model: onnx.ModelProto = onnx.ModelProto.FromString(buffer.getvalue())
    stated = {
        "task": "detect", "stride": MULTIPLE_PX, "batch": 1, "imgsz": [side_px, side_px], "channels": 3,
        "names": dict(enumerate(names)),
    }  # fmt: skip
    onnx.helper.set_model_props(model, {**{key: str(value) for key, value in stated.items()}, **about})
    return model
