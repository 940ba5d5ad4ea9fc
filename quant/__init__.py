"""The numbers: from a float network to INT8 under a DPU's rules, and what that costs.

float ONNX (`onnx_file`) -> `graph` -> `samples` -> `passes` -> integer `core` -> two
`encodings`: the host's file for onnxruntime, the board's for its own flow

- `quantize` does it in one call;
- `session` runs networks on onnxruntime, `kernels` in ways that add exactly on this processor;
- `integer` is the core's arithmetic in integers, `bounds` proves what holds for any input;
- `gate` measures what INT8 changes, `limits` and `structure` judge it, `sensitivity` says which
  layers err;
- `tiling` says how an image may be cut for a network: lattice, halo and scale; `samples` are
  simulated patches or a user's own;
- `onnx` has the one graph of a file, `simplify` folds what exporters leave in a float one, and
  `untrusted` checks files before they are used.
"""

import os
import sys


def _switch_off_telemetry() -> None:
    """Keep onnxruntime and OpenVINO from reporting their use.

    onnxruntime's wheels (1.29 and later) keep an identifier in the home folder and send events from
    native code. That begins as the library is loaded, so its switch must be set before. OpenVINO
    reports its import through a package beside it; where that cannot be imported it takes a stub of
    its own. A choice made before is kept.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    absent: dict[str, object] = sys.modules  # type: ignore[assignment]  # None is Python's mark for "do not import"
    absent.setdefault("openvino_telemetry", None)


# Here, because a runtime's first import anywhere in this package is too late.
_switch_off_telemetry()
