"""Training: pairs made as they are needed, the paper's loss, averaged weights, exact resume.

- `patches` simulates pairs on the fly or takes stored ones; both are keyed by (seed, step), so any batch can be made
  again;
- `losses` holds the terms, `guards` what stops a run gone wrong, `precision` the number format of a step;
- `trainer` runs the steps, `checkpoint` keeps them with the recipe, `interrupts` lets Ctrl-C break none;
- `workers` shares a run out to processes, `validation` judges on sites held out.

It offers no names of its own: `restore` holds back Ctrl-C by `interrupts` and needs no torch.
"""
