"""What a network takes: measured on this machine, predicted for the DPU, published by the paper, side by side.

- `board`: a swath on the DPU beside its rivals; `tables`: the rows of it;
- `host`: networks and the traditional pipeline on this machine;
- `profile`: its time by node, its power, and how several calls are timed so that they can be compared.
"""
