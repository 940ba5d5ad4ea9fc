"""Activations that a DPU lacks are replaced by ones that it computes, if a user asks for it.

- `replacements`: which operators are replaced, by another function or exactly;
- `compensation`: fits the convolutions behind another function to the original network;
- `adaptation`: chooses for each kind of operator, and measures what that costs.
"""
