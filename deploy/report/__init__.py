"""Reports: one self-contained HTML file, pictures embedded, every number with its mode.

- `page` renders figures, tables and pictures; `plots` draws with matplotlib;
- `evaluation_page` and `sensitivity_page` say what stands on the pages of `evaluate` and of `quantize --report`.
"""
