"""Replace activations that a DPU lacks by ones that it computes, if a user asks for it.

- `replacements`: which operators are replaced, by another function or exactly;
- `compensation`: fits the convolutions behind another function to the original network;
- `adaptation`: chooses for each kind of operator, and measures the loss.
"""
