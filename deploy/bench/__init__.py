"""What a network takes: measured on this machine, predicted for the DPU, published by the paper, side by side.

- `board`: a swath on the DPU beside its rivals; `tables`: the rows of it;
- `host`: networks and the traditional pipeline on this machine;
- `rates`: how fast this processor does each kind of work; `board_cpu`: the pipeline scaled by them to a board's;
- `profile`: its time by node, its power, and how several calls are timed so that they can be compared.
"""
