"""Replace operators that a DPU lacks by ones that it computes, if a user asks for it.

- `kinds`: the kinds of operators that are replaced;
- `replacements`: by another function, or by the same function in other operators;
- `zero_padding`: replaces reflected borders by zeros;
- `inverse_deviation`: fits convolutions that replace a division by a standard deviation;
- `compensation`: fits the convolutions behind another function to the original network;
- `adaptation`: chooses the replacement of each kind, and measures the loss.
"""
