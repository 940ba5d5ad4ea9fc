"""`import beers_deploy as bd`: satellite image restoration from training to board, as a library.

Nouns are values: `Sensor`, `Network`, `Board`, `Pair`, `Table`. Verbs are functions that return
values, and write files only where they are given an output; each is a command too. `sensors`,
`boards` and `networks` list what is shipped. A name is loaded when it is first used. Inside:

- `verbs`: one verb a file: signature and docstring are those of the library, the command and its
  help; `cli` makes the commands;
- `network`: a network as a value; `network_files`, `conditioned_file`: its file, by its name and
  for its sensor; `float_onnx`, `onnx_export`, `parity`: written as ONNX, and compared;
- `quantization`, `comparison`, `verdict`, `pairs`: the steps of the verbs; `kit`: what a board's
  engineer gets;
- `restoration`: images of any size through a network or the traditional pipeline;
- `dpu`: the checker of operators and the cost model; `performance`: times, predicted and measured;
- `results`: figures as one table, JSON document and page; `tables` and `report` show them;
  `shipped_tables`: the shipped data as tables;
- `studies`: long-running work: evaluation, trade-off, stress, detection, a sensor from its images,
  and the recipes that make the shipped networks.
"""

from typing import Any

import lazy_loader

import beers_deploy.quant  # noqa: F401  # switches telemetry off before a module here loads a runtime

__version__ = "1.0.0"

_loaded, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Load and return the public object with this name."""
    try:
        return _loaded(name)
    except ImportError as error:
        # This loads NumPy, and `__main__` must run without it.
        from beers_deploy.profiles.errors import missing_extra

        raise missing_extra(error, name) from error
