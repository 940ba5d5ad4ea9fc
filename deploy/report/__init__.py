"""Reports: one self-contained HTML file, pictures embedded, every number with its mode.

- `page` renders figures, tables and pictures; `plots` draws with matplotlib;
- `sensitivity_page` composes the page of `quantize --report`.
"""
