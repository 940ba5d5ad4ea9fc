"""Training: pairs made as they are needed, the paper's loss, averaged weights, exact resume.

- `patches` simulates pairs on the fly or takes stored ones; both are keyed by (seed, step), so any
  batch can be made again;
- `losses` holds the terms;
- `trainer` runs the steps, on one process or several; `checkpoint` keeps them with the recipe, and
  holds what stops a run gone wrong; `run` is a whole run from options to a folder;
- `validation` judges it on sites that are not trained on; `grow` starts a network from a smaller
  one.
"""
