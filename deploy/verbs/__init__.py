"""The verbs: each is one function, of which the command line, its help, the library and the
reference are made.

A verb has keyword-only options; its docstring is the only text about them. It imports what it needs
when it runs, so that `--help` stays quick.
"""
