"""Long work on top of the verbs, studies and the making of networks: only its
commands import it.
"""
