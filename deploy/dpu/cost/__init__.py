"""How long a network takes on the DPU, at what power, and how the constants behind that are fitted.

- `layers`: what each layer computes and moves; `latency`: how long that takes, with an interval;
- `fit`: the constants from published rates; `validation`: the errors on networks left out, and a user's own runs.
"""
