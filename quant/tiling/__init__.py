"""How an image may be cut into tiles for a network, such that the result is the whole image's, bit for bit.

- `walk`: the contract, and the walk along a network that finds lattice, halo and scale: `tiling_of`;
- `reach`: what a tensor's pixels depend on, and what each operator adds to that;
- `spelled_out`: pixel shuffles in a row of Reshapes, seen as one operator.
"""
