"""Define the compressions of an output. It imports nothing, so that '--help' stays fast."""

from typing import Literal

Compression = Literal["none", "zlib", "zstd", "lzw"]
"""The lossless compressions of a TIFF."""
