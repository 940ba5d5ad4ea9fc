"""`import beers_deploy as bd`: satellite image restoration from training to board, as a library.

Nouns are values: `Sensor`, `Network`, `Board`, `Pair`, `Table`. Verbs return values and write files
only where they are told to: `simulate`, `restore`, `quantize`, `compare`, `gate`, `check`,
`predict`, `evaluate`, `tradeoff` and `characterize`. `sensors`, `boards` and `networks` list what
is shipped. What is offered is loaded when it is asked for. Inside:

- `network`: a network as a value; `library`, `quantise`, `verdict`, `pairs`, `board`: a verb or two
  each;
- `restoration`: images of any size through a network or the traditional pipeline;
- `dpu` and `bench`: the checker of operators, the cost model, and what they say of a swath;
- `results`, `frames`, `report`: figures as tables, JSON, DataFrames and pages; `baseline` reads
  JSON again;
- `studies`: what takes hours and writes pages: `evaluation`, `characterise`, `stress`, `detection`,
  `tradeoff`, `demo`, and `recipes`, which make the shipped networks;
- `cli` and `commands`: a file a command, which parses options, calls one function and prints.
"""

from typing import Any

import lazy_loader

import beers_deploy.quant  # noqa: F401  # switches telemetry off before a module here loads a runtime

__version__ = "1.0.0"

_loaded, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """What is offered under a name, loaded now."""
    try:
        return _loaded(name)
    except ImportError as error:
        # This loads NumPy, which `__main__` has to survive without.
        from beers_deploy.profiles.errors import missing_extra

        raise missing_extra(error, name) from error
