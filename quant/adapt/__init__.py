"""Replace operators that a DPU lacks by ones that it computes, if a user asks for it.

- `kinds`: which operators are replaced;
- `replacements`: by what, another function or the same spelled otherwise;
- `inverse_deviation`: fits what replaces a division by a standard deviation;
- `compensation`: fits the convolutions behind another function to the original network;
- `adaptation`: chooses for each kind of operator, and measures the loss.
"""
