"""A whole acquisition, row of tiles by row of tiles: exact seams, little memory, resumable.

reader (bands of rows) -> engine (tiles through the runtime) -> spool (finished rows, journal) -> writer (tiled TIFF)
"""
