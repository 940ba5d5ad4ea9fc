"""Convert rows of raw pixels to rows of restored ones, tile by tile.

missing    fills missing pixels from known ones nearby
exposures  a network at several exposures, and the choice of one for each pixel
engine     restores one tile: `Restorer`
rows       the one tile loop, for files and arrays: `restore_rows`, `gathered`, `restore_dn`
lazy       the same for a lazy array of Dask, as tasks
"""
