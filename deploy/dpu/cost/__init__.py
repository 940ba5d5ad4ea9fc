"""How long a network takes on a DPU, at what power, and how the constants behind that are fitted.

- `work`: what each layer computes and moves; `layers`, `host`: how long that takes; `latency`: the prediction;
- `constants`: what stands in a target's [cost];
- `fit`: the constants from the rates in `published`; `validation`: errors on families left out; `runs`: a user's own.
"""
