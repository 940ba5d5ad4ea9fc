"""Train networks: pairs simulated when needed, the paper's loss, averaged weights, exact resume.

- `patches` simulates pairs on the fly or reads stored ones; both are keyed by (seed, step), so any
  batch can be regenerated. `source` has the scenes, `passes` simulates one pass of a sensor, and
  `looks` varies the ground;
- `losses` defines the terms of the loss, `step` is one gradient step;
- `trainer` runs the steps, on one process or several; `checkpoint` stores them with the recipe, and
  defines the guards that stop a failing run; `run` is a whole run from options to a folder;
  `recipe` reads the recipes of the shipped networks;
- `validation` evaluates it on sites that are not trained on; `grow` starts a network from a smaller
  one.
"""
