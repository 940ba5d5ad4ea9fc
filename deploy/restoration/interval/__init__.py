"""The half-widths of a restored image.

`half_widths` computes them from finished rows, by the calibrated interval of a network, and `file`
writes them next to the image.
"""
