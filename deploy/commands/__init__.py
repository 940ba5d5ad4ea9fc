"""One file a command: its options, its calls into the library, its table.

Heavy imports stand inside functions.
"""
