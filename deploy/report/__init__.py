"""Reports: one self-contained HTML file, pictures embedded, every number with its mode.

`page` renders tables and figures, `pictures` shows 12-bit images, `plots` draws with matplotlib; `blame_page` and
`demo_page` are the pages of `quantize --report` and `demo`.
"""
