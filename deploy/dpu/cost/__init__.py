"""Predict the time and the power of a network on a DPU.

- `work`: what each layer computes and moves, counted from shapes;
- `model`: the constants of a target's [cost], and the times of layers that follow;
- `host`: the work of the host, and its time where no rate is published;
- `latency`: the prediction of time with its interval, and of power;
- `own_runs`: the runs of a user's own board, by which `kinship` corrects predictions.

The constants are fitted by `benchmarks/cost_model`.
"""
