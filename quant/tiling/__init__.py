"""Determine how an image may be cut into tiles for a network so that the result equals that of the
whole image, bit for bit.

- `receptive_field`: the contract, and the traversal of a network that finds lattice, halo and
  scale: `tiling_of`;
- `axis_maps`: which pixels of its source each operator reads.
"""
