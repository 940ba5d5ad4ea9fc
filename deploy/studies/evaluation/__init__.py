"""Compare methods on the same pairs and targets: scores with intervals, by image and by site.

- `methods`: the type of a method, and the one with a name; `pairs`: degraded and reference
  images, simulated or read;
- `scores`: figures of one method on pairs;
- `target_scenes`: edges, flat fields, points and patterns whose truth is known; `targets`:
  figures of one method on them;
- `run`: an evaluation of several, and its page; `sweep`: the same under other sensors, whose
  parameters are known or wrong; `compression`: restoration on board before compression, or on
  the ground after it.
"""
