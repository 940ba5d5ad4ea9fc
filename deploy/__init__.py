"""The machine: what a network needs from training to a board that flies, and the command line.

- `commands`, reached from `cli`: a file a verb, which parses options, calls one function and prints;
- `restoration`: images of any size through a network or the traditional chain; `library` does it for arrays;
- `dpu`: the checker of operators, the cost model and the published networks that it is fitted on;
- `export`, `quantise`, `gate`, `compare`: a network as a file, in INT8, judged, and two runs' figures side by side;
- `bench`, `tradeoff`, `stress`, `demo`: how fast, at what price, how sturdy, and all of it in minutes;
- `methods`: restorations by name, which `evaluate` compares;
- `results` and `report`: figures as tables, JSON and HTML;
- `cluster`, `dataset_workers`: the workers of Dask.

What is offered here is loaded when it is asked for.
"""

import lazy_loader

import quant  # noqa: F401  # switches telemetry off before a module here loads a runtime

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
