"""What makes INT8 lose less than rounding every tensor would: one file a pass, each with its
reason.

`benchmarks/ablation.py` measures what each buys.
"""
