"""Passes that make INT8 lose less than rounding every tensor would, one file each.

- `least_squares`: the scale of each tensor.
- `residual_groups`: the tensors that adds connect, and those that stand alone.
- `equalize`, `equalize_single`: factors for the channels of both; `trial`: what factors cost;
  `effort`: how many are tried.
- `dual_range`: the result in copies of several scales.
- `finetune`: the integers trained with their rounding; `scales`: scales moved between the rounds.
- `selection`: the passes to apply; `benchmarks/ablation.py` measures what each buys.
"""
