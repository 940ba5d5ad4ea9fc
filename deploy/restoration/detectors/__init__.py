"""Detect faults of single detectors in a raw image, warn of them, and replace them on request.

`look` searches strips of an image and warns of the faults there, `fault_list` reads and writes
lists of faults, and `fix` replaces their pixels while rows are read.
"""
