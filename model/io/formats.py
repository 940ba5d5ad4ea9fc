"""Recognise network files in formats that are not supported, to explain in one sentence how to
convert them.
"""

from typing import NamedTuple

HEAD_BYTES = 4096
"""The number of leading bytes from which the format of a file is recognised."""

FROM_TORCH = (
    "export the network itself with torch.onnx.export, because weights alone lack its layers"
)
FROM_TENSORFLOW = "convert it with tf2onnx"


class OtherFormat(NamedTuple):
    """A format that is recognised but not supported.

    Attributes:
        name: the name of the format in a sentence.
        remedy: how to convert a network of this format to an ONNX file.
    """

    name: str
    remedy: str


TORCH = OtherFormat("a file of PyTorch, whose pickles are not opened", FROM_TORCH)
ARCHIVE = OtherFormat("a ZIP archive", "unpack it first")
SAFETENSORS = OtherFormat(
    "safetensors weights",
    "export it first: beers-deploy export --network FILE.safetensors --out FILE.onnx",
)

MAGIC: tuple[tuple[int, bytes, OtherFormat], ...] = (
    (0, b"\x80\x02", TORCH),  # Before torch 1.6: a pickle of protocol 2.
    (0, b"\x89HDF\r\n", OtherFormat("an HDF5 file, such as Keras writes", FROM_TENSORFLOW)),
    (4, b"TFL3", OtherFormat("a file of TensorFlow Lite", f"{FROM_TENSORFLOW}, by its --tflite")),
    (
        4,
        b"ORTM",
        OtherFormat(
            "a file in onnxruntime's own format", "give the ONNX file that it was made from"
        ),
    ),
    (
        0,
        b"<?xml",
        OtherFormat("an XML file, such as OpenVINO's", "give the ONNX file that it was made from"),
    ),
    (
        0,
        b"\x93NUMPY",
        OtherFormat("an array of NumPy", "export the network that it belongs to as ONNX"),
    ),
)
"""Position of the bytes that all files of a format share, these bytes, and the format."""


def other_format(head: bytes) -> OtherFormat | None:
    """Return the format of a file that is not ONNX, or None if it is not recognised.

    Args:
        head: the first bytes of the file.
    """
    # torch.save writes a ZIP archive that holds data.pkl.
    if head.startswith(b"PK\x03\x04"):
        return TORCH if b"data.pkl" in head or b"/version" in head else ARCHIVE
    # A safetensors file begins with the length of its JSON header, in 8 bytes.
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 1 << 32:
        return SAFETENSORS
    return next((kind for place, magic, kind in MAGIC if head[place:].startswith(magic)), None)
