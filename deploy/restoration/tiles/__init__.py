"""Convert rows of raw pixels to rows of restored ones, tile by tile.

exposures  a network at several exposures, and the choice of one for each pixel
engine     restores one tile, whose missing pixels it fills from those nearby: `Restorer`
rows       the one tile loop, for files and arrays: `restore_rows`, `gathered`, `restore_floats`
lazy       the same for a lazy array of Dask, as tasks
"""
