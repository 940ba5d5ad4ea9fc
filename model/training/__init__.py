"""Training: pairs made as they are needed, the paper's loss, averaged weights, exact resume.

- `patches` simulates pairs on the fly, `stored_pairs` takes them from a data set on disk; both are keyed by (seed,
  step), so any batch can be made again;
- `losses` holds the terms, `recipe` all that decides the weights, `guards` what stops a run gone wrong;
- `trainer` runs the steps, `checkpoint` keeps them, `interrupts` lets none break one, `workers` shares a run out,
  `validation` judges on sites held out.
"""
