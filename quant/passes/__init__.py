"""What makes INT8 lose less than rounding every tensor would: one file a pass, each with its reason.

Each can be switched off (`quant.quantise.Passes`); `quantize --ablate` prints what each buys.
"""
