"""The machine: what a network needs from training to a board that flies, and the command line.

- `commands`, reached from `cli`: a file a verb, which parses options, calls one function and prints;
- `restoration`: images of any size through a network or the traditional chain; `library` does it for arrays;
- `dpu`: the checker of operators and the cost model;
- `export`, `quantise`, `gate`, `compare`: a network as a file, in INT8, judged, and two runs' figures side by side;
- `bench`: how fast, and at what price;
- `studies`: what the verbs are worth: `evaluation`, `characterise`, `stress`, `detection`, `tradeoff`, `demo`;
- `results` and `report`: figures as tables, JSON and HTML;
- `cluster`: the workers of a Dask scheduler.

What is offered here is loaded when it is asked for.
"""

import lazy_loader

import beers_deploy.quant  # noqa: F401  # switches telemetry off before a module here loads a runtime

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
