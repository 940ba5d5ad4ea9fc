"""Faults of single detectors in an image to restore: looked for, told, and replaced where the user
asks for it.

`look` reads strips of an image, `words` says what was found, `fault_list` is a list of faults and
its file, and `fix` replaces their pixels while rows are read.
"""
