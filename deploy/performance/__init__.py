"""What a network takes: predicted for the DPU, measured on this machine, published by the paper,
side by side.

- `board`: a swath on the DPU beside its rivals; `tables`: the rows of it;
- `host`: networks on this machine; `traditional`: the traditional pipeline on it;
- `timing`: time by node, power, and how several calls are timed so that they can be compared.
"""
