"""What accuracy costs in time: operating points measured on the same images, and which of them is worth its price.

`run.run_study` measures what the cache lacks (`measurements`, by the methods of `methods`, on the benchmark set of
`accuracy`), puts results together (`outcome`), and finds fronts and advice (`advice`); `page` writes the report.
"""
