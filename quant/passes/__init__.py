"""Passes that reduce the INT8 error compared with rounding every tensor, one file each.

- `least_squares`: the scale of each tensor.
- `residual_groups`: the tensors that adds connect, and single tensors; `long_skip`: takes the image
  out of a long skip connection.
- `equalize`, `equalize_single`: factors for the channels of both; `trial`: the error of factors;
  `effort`: how many are tried.
- `dual_range`: the result in copies of several scales.
- `finetune`: the integers trained with their rounding; `scales`: scales changed between the rounds.
- `selection`: the passes to apply; `benchmarks/ablation.py` measures the gain of each.
"""
