"""Compare accuracy with time: operating points measured on the same images, and a
recommendation.

- `points`: the operating points; `measure` measures each variant once;
- `front`: the points that no other beats; `advice`: the one to recommend;
- `run`: a whole study; `page`: its result as a page.
"""
