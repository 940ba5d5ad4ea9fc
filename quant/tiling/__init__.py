"""How an image may be cut into tiles for a network so that the result stays
the whole image's, bit for bit.

- `receptive_field`: the contract, and the walk along a network that finds lattice, halo and scale:
  `tiling_of`;
- `axis_maps`: which pixels of its source each operator reads.
"""
