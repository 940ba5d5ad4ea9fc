"""The compressions of an output. It imports nothing, so that '--help' stays quick."""

from typing import Literal

Compression = Literal["none", "zlib", "zstd", "lzw"]
"""The lossless compressions of a TIFF."""
