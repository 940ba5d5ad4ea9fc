"""Reports: one self-contained HTML file, pictures embedded, every number with its mode.

- `page` renders figures, tables and pictures; `plots` draws with matplotlib;
- `sensitivity_page` composes the page of `quantize --report`;
- `view` shows a restored image and its raw one; OpenSeadragon draws them. `openseadragon/` contains
  it unchanged, with its licence.
"""
