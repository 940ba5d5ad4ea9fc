"""Detect faults of single detectors in a raw image, warn of them, and replace them on request.

`strips` detects faults in strips of an image and warns of them, `fault_list` reads and writes
lists of faults, and `fix` replaces their pixels while rows are read.
"""
