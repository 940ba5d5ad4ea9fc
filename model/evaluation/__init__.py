"""Methods compared on the same pairs and targets: scores with intervals, by image and by site.

- `methods`: what a method is, and those that need no network;
- `pairs`: degraded and reference images, simulated or read; `targets`: edges and flat fields whose truth is known;
- `scores`: figures of one method; `run`: an evaluation of several;
- `sweep`: the same under other sensors, known as they are or wrongly; `sweep_rows`: its tables.

What is offered here is loaded when it is asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
