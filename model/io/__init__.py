"""What is read from disk and written to it, whole files or none.

- `images`: pixels of TIFF, PNG and JPEG files, and which value is full scale; `tiff`: untrusted TIFF pages;
- `files`: outputs that are written whole, and never over an input;
- `tensors`: weights as safetensors.
"""

from beers_deploy.model.io.files import require_writable, sha256, whole_file, write_text
from beers_deploy.model.io.images import list_images, read_pixels, settled_scale, site_of
from beers_deploy.model.io.tiff import open_tiff

__all__ = [
    "list_images",
    "open_tiff",
    "read_pixels",
    "require_writable",
    "settled_scale",
    "sha256",
    "site_of",
    "whole_file",
    "write_text",
]
