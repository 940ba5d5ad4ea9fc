"""A whole acquisition restored, row of tiles by row of tiles: exact seams, little memory, resumable.

source (bands of rows) -> engine (tiles through the runtime) -> output (finished rows, journal, tiled TIFF)

With workers, `workers` takes the engine's place: each has a source and restores rows of its own. `arrays` restores
what is in memory already, `traditional` by the chain instead of a network.
"""
