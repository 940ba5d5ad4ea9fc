"""How an image may be cut into tiles for a network, such that the result is the whole image's, bit
for bit.

- `walk`: the contract, and the walk along a network that finds lattice, halo and scale:
  `tiling_of`;
- `steps`: what each operator's pixels read.
"""
