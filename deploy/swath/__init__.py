"""A whole acquisition, row of tiles by row of tiles: exact seams, little memory, resumable.

reader (bands of rows) -> engine (tiles through the runtime) -> spool (finished rows, journal) -> writer (tiled TIFF)

With workers, spread takes the engine's place: each worker has a reader and restores rows of its own.
"""
