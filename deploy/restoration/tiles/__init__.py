"""From rows of raw pixels to rows of restored ones, tile by tile.

missing    fills missing pixels from known ones that lie near
exposures  a network at several exposures, and which one a pixel takes
engine     what restores one tile: `Restorer`
rows       the one tile loop, for files and arrays: `restore_rows`, `gathered`, `restore_dn`
lazy       the same of a lazy array of Dask, as tasks
"""
