"""The numbers: from a float network to INT8 under a DPU's rules, and the accuracy that this costs.

float ONNX (`onnx_file`) -> `graph` -> `samples` -> `passes` -> integer `core` -> two
`encodings`: the host's file for onnxruntime, the board's for its own flow

- `quantize` runs all of it in one call;
- `session` runs networks on onnxruntime, `kernels` in ways that add exactly on this processor;
- `integer` is the core's arithmetic in integers, `bounds` proves bounds for any input;
- `gate` measures the effect of INT8, `limits` and `structure` judge it, `sensitivity` measures the
  error of each layer;
- `tiling` determines how an image may be cut into tiles for a network: lattice, halo and scale;
  `samples` are simulated patches or a user's own;
- `sensor_bank` makes one file for every sensor; `host_part` is what the host computes; `adapt`
  replaces operators that a DPU lacks;
- `plan` holds the steps of a quantisation, and `price` measures what each restriction costs;
- `c_code` writes the core as C;
- `onnx` represents the one graph of a file, `simplify` folds what exporters leave in a float one,
  and `untrusted` checks files before they are used.
"""

import os
import sys

# Prevent onnxruntime and OpenVINO from reporting their use. This is done here, because a runtime's
# first import anywhere in this package is too late.
#
# onnxruntime's wheels (1.29 and later) store an identifier in the home folder and send events from
# native code. That begins when the library is loaded, so its switch must be set before. OpenVINO
# reports its import through another package. If that cannot be imported, it uses a stub of its own.
# An earlier choice of the user is respected.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
_absent: dict[str, object] = sys.modules  # type: ignore[assignment]  # None is Python's mark for "do not import"
_absent.setdefault("openvino_telemetry", None)
