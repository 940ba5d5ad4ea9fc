"""Long-running work on top of the verbs: studies and the training of networks. Only its commands
import it.
"""
