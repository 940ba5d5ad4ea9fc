"""The compressions of an output. It imports nothing, so that '--help' stays quick."""

from enum import StrEnum


class Compression(StrEnum):
    """The lossless compressions of a TIFF."""

    none = "none"
    zlib = "zlib"
    zstd = "zstd"
    lzw = "lzw"
