"""Time and power of a network: predicted for the DPU, measured here, published by the paper.

- `board`: a swath on the DPU, next to the traditional pipeline and the paper; `tables`: its rows;
- `dry_run`: the time that a restoration would take, here and on a board;
- `swath`: the image, its tiles, and predicted figures;
- `host`: networks on this machine; `traditional`: the traditional pipeline on it;
- `timing`: time by node, power, and how several calls are timed so that they can be compared.
"""
