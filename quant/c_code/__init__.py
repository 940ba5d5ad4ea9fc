"""The integer core as one C99 file: integers only, static buffers, no heap, no library.

- `program`: the whole file, and which tensors share a buffer;
- `layers`: the constants and the call of each operation;
- `kernels/`: the C functions that the calls use, one file for each kind of operation.
"""

from beers_deploy.quant.c_code.program import c_program

__all__ = ["c_program"]
