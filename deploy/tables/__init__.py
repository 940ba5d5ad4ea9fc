"""Rows of figures shown: on a terminal, as HTML, as Markdown, as a pandas DataFrame and as bars.

- `columns`: what the outputs share: names, units and modes of columns, reasons of missing figures
- `terminal`, `markup`, `frames`: the outputs
"""
